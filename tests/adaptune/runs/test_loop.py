import csv
import json
import math
import time

import drives
import numpy as np
import pytest

from adaptune.bank.bank import Bank
from adaptune.errors import AdaptuneError, OdometryError
from adaptune.odometry.base import InProcess, Odometry, Registration, Usage
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording.scan import Scan
from adaptune.runs.files import read_run, write_run
from adaptune.runs.loop import replay
from adaptune.space import Float, ParameterSpace, Selection
from adaptune.trajectory import read_tum


class Scripted(Odometry):
    """Moves along x by the steps it is given, and remembers what was done to it."""

    space = ParameterSpace({"speed": Float(low=0.0, high=9.0, baseline=1.0)})
    live = True

    def __init__(self, steps=()):
        super().__init__()
        self.steps = list(steps)
        self.events = []

    def prepare(self, scan):
        return scan.stamp

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        motion = None if T_previous_current is None else float(T_previous_current[0, 3])
        self.events.append(("start", prepared, float(T_odom_sensor[0, 3]), motion))
        self.T = T_odom_sensor

    def register(self, prepared):
        self.events.append(("register", prepared, self.parameters["speed"]))
        step = self.steps.pop(0) if self.steps else 0.1
        self.T = self.T.copy()
        self.T[0, 3] += 0.0 if step is None else step
        return Registration(self.T, registered=step is not None)

    def configure(self, parameters):
        super().configure(parameters)
        self.events.append(("configure", parameters["speed"]))


def scans(stamps):
    return [Scan(int(s * 1e9), np.zeros((0, 3), np.float32)) for s in stamps]


class Cautious(HealthCheck):
    max_acceleration = 20.0


HEALTH = Cautious(max_speed=5.0)
ABOUT = {"mode": "x", "parameters": None, "model": None, "real_time": None}


class Chooser:
    """Chooses among sets by a function of the number of selections."""

    def __init__(self, sets, choose=lambda n: n % 2):
        self.sets, self.choose = sets, choose
        self.seen, self.asked, self.measured = [], [], []

    def observe(self, stamp, scan, motions):
        assert scan.stamp == stamp
        self.seen.append((stamp, motions.T_previous_current[0, 3]))

    def select(self):
        self.asked.append(self.seen[-1][0])
        i = self.choose(len(self.asked))
        return Selection(i, self.sets[i], None, 0.5, 1.0)

    def measure(self):
        self.measured.append((self.seen[-1][0], len(self.asked)))


def test_selects_at_the_first_scan_and_then_every_period_before_registering():
    odometry = Scripted()
    selector = Chooser([{"speed": 3.0}, {"speed": 4.0}])
    stamps = [0.0, 0.4, 0.8, 1.0, 1.2, 1.9, 2.3, 4.95, 5.0, 5.05]
    result = replay(scans(stamps), InProcess(odometry), HEALTH, selector)
    assert [s / 1e9 for s in selector.asked] == [0.0, 1.0, 2.3, 4.95, 5.0]
    assert [c.stamp for c in result.choices] == selector.asked
    # It measures once after every selection.
    assert selector.measured == [(stamp, n + 1) for n, stamp in enumerate(selector.asked)]
    # Every scan is observed, with the motion over the scan before it.
    assert [stamp / 1e9 for stamp, _ in selector.seen] == stamps
    moved = [x for _, x in selector.seen][:9]  # then the health check steps in
    np.testing.assert_allclose(moved, [0.0, 0.0] + [0.1] * 7, atol=1e-12)
    assert [c.selection.parameters["speed"] for c in result.choices] == [4.0, 3.0, 4.0, 3.0, 4.0]
    # The change comes before the scan that it was made from.
    assert odometry.events[:2] == [("configure", 4.0), ("start", 0, 0.0, None)]
    at = odometry.events.index(("register", 1_000_000_000, 3.0))
    assert odometry.events[at - 1] == ("configure", 3.0)


def test_the_selector_sees_healthy_motions():
    selector = Chooser([{"speed": 3.0}] * 2)
    replay(scans(np.arange(6) / 10), InProcess(Scripted([0.1, 0.2, 3.0, 0.2])), HEALTH, selector)
    np.testing.assert_allclose([x for _, x in selector.seen], [0, 0, 0.1, 0.2, 0.15, 0.2])


def test_without_a_selector_nothing_is_changed():
    odometry = Scripted()
    result = replay(scans(np.arange(30) / 10), InProcess(odometry), HEALTH)
    assert not [event for event in odometry.events if event[0] == "configure"]
    assert result.choices == []
    np.testing.assert_allclose(result.trajectory.T_world_sensor[:, 0, 3], np.arange(30) * 0.1)


@pytest.mark.parametrize("jump", [3.0, -2.0, np.nan, np.inf])
def test_an_impossible_step_restarts_at_the_last_healthy_motion(jump):
    odometry = Scripted([0.1, 0.2, jump, 0.2])
    result = replay(scans(np.arange(6) / 10), InProcess(odometry), HEALTH)
    assert np.flatnonzero(result.restarted).tolist() == [3]
    x = result.trajectory.T_world_sensor[:, 0, 3]
    np.testing.assert_allclose(x, [0.0, 0.1, 0.3, 0.45, 0.65, 0.75])
    start = [event for event in odometry.events if event[0] == "start"][1]
    assert start[1] == 300_000_000
    assert start[2:] == pytest.approx((0.45, 0.15))


def test_a_platform_that_did_change_its_motion_is_believed_in_the_end():
    # From 0.1 to 0.45 m a scan is 3.5 m/s at once; the bound grows with the time unseen.
    odometry = Scripted([*[0.1] * 12, *[0.45] * 18])
    result = replay(scans(np.arange(31) / 10), InProcess(odometry), HEALTH)
    assert np.flatnonzero(result.restarted).tolist() == [22]  # it might have been taken back
    assert np.diff(result.trajectory.T_world_sensor[:, 0, 3])[-1] == pytest.approx(0.45)


def test_after_a_dropped_scan_the_last_motion_goes_on_for_longer():
    odometry = Scripted([0.1, 0.1, 50.0, 0.1])
    result = replay(scans([0.0, 0.1, 0.2, 0.5, 0.6]), InProcess(odometry), HEALTH)
    assert result.restarted.tolist() == [False, False, False, True, False]
    x = result.trajectory.T_world_sensor[:, 0, 3]
    np.testing.assert_allclose(x, [0.0, 0.1, 0.2, 0.5, 0.6])
    (restart,) = [event for event in odometry.events if event[0] == "start"][1:]
    np.testing.assert_allclose(restart[2:], [0.5, 0.3])


def test_too_many_scans_that_do_not_register_restart(tmp_path, monkeypatch):
    monkeypatch.setattr(HealthCheck, "max_unregistered", 3)
    odometry = Scripted([0.1, 0.1, *[None] * 7, 0.1])
    result = replay(scans(np.arange(11) / 10), InProcess(odometry), HEALTH)
    assert np.flatnonzero(result.restarted).tolist() == [5, 8]
    assert result.unhealthy == {"max_unregistered": 2}
    write_run(tmp_path, result, ABOUT)
    summary = json.loads((tmp_path / "replay.json").read_text())
    assert summary["unhealthy"] == {"max_unregistered": 2}
    assert summary["poor_scans"] == sum(not step.registered for step in result.steps) == 7


class Losing(Chooser):
    """Says at which of its selections the bank is lost."""

    def __init__(self, lost):
        super().__init__([{"speed": 1.0}], lambda _: 0)
        self.lost = lost

    def select(self):
        selection = super().select()
        return selection._replace(state="lost" if self.lost[len(self.asked) - 1] else "good")


def test_the_log_says_when_an_odometry_is_lost_and_when_it_goes_on(tmp_path, caplog):
    selector = Losing([True, True, False, True])
    result = replay(
        scans(np.arange(36) / 10), InProcess(Scripted()), HEALTH, selector, what="a, adaptive"
    )
    assert caplog.messages == [
        "a, adaptive: the odometry is lost at 0.0 s",
        "a, adaptive: the odometry goes on at 2.0 s",
        "a, adaptive: the odometry is lost at 3.0 s",
    ]
    write_run(tmp_path, result, ABOUT)
    summary = json.loads((tmp_path / "replay.json").read_text())
    assert summary["lost_seconds"] == 2.5  # the last selection holds until the end


def test_no_scans():
    with pytest.raises(AdaptuneError, match="no scan to replay; check start and stop"):
        replay([], InProcess(Scripted()), HEALTH)


def test_a_real_replay_is_the_same_every_time(tmp_path):
    drive = [Scan(stamp, points) for stamp, points, _ in drives.scans(0, 25)]
    sets = [
        {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0},
        {"max_correspondence_distance": 0.7, "keyframe_interval": 3.0},
    ]

    odometries = [InProcess(KeyframeGicp(sets[0])) for _ in range(2)]
    results = [replay(drive, one, HealthCheck(), Chooser(sets)) for one in odometries]
    a, b = (r.trajectory.T_world_sensor for r in results)
    np.testing.assert_array_equal(a, b)
    assert abs(a[-1, 0, 3] - 24 * 0.3) < 0.1
    write_run(tmp_path, results[0], ABOUT)
    written = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(written.stamps, [stamp for stamp, _, _ in drives.scans(0, 25)])
    np.testing.assert_allclose(written.T_world_sensor, a, atol=1e-8)
    with (tmp_path / "selections.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["stamp_ns"]) for row in rows] == [c.stamp for c in results[0].choices]
    assert {row["predicted_error_percent"] for row in rows} == {"0.5000"}
    assert {float(row["keyframe_interval"]) for row in rows} == {1.0, 3.0}


def test_what_a_replay_costs_is_measured_without_reading(tmp_path):
    class Busy(Scripted):
        def register(self, prepared):
            spend(0.003)
            return super().register(prepared)

    class Elsewhere(InProcess):
        usage = Usage(cpu=1.0, memory=1000.0, other_cpu=0.5)

    def reading(of):
        for scan in of:
            spend(0.02)
            yield scan

    result = replay(reading(scans(np.arange(20) / 10)), InProcess(Busy()), HEALTH)
    assert 2.5 < result.cpu_ms < 12.0
    assert 20.0 < result.memory < 20_000.0
    other = replay(scans(np.arange(20) / 10), Elsewhere(Busy()), HEALTH)
    # Half a second in other processes, for twenty scans.
    assert 27.0 < other.cpu_ms < 40.0
    assert other.memory > 1000.0
    write_run(tmp_path, other, ABOUT)
    summary = json.loads((tmp_path / "replay.json").read_text())
    assert summary["cpu_ms"] == round(other.cpu_ms, 3)
    assert summary["memory_mb"] == round(other.memory, 1)


def spend(seconds):
    """Spend CPU time."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


def test_selections_of_several_odometries_are_stored_with_gaps(tmp_path):
    sets = [{"odometry": "a", "speed": 1.0, "kernel": "huber"}, {"odometry": "b", "points": 3}]

    class Any(InProcess):
        def apply(self, selection):
            """Take it as it is."""

    result = replay(scans(np.arange(21) / 10), Any(Scripted()), HEALTH, Chooser(sets))
    write_run(tmp_path, result, ABOUT)
    choices = read_run(tmp_path).values
    assert choices["odometry"] == ["b", "a", "b"]
    np.testing.assert_array_equal(choices["speed"], [np.nan, 1.0, np.nan])
    np.testing.assert_array_equal(choices["points"], [3.0, np.nan, 3.0])
    assert choices["kernel"] == ["", "huber", ""]


TENTH = 10**8
STEP = 0.1
FIXED = Selection(0, {"gain": 1.0})


class Fragile(Odometry):
    """Moves as it should while `gain` is 1, and else as told by a function of stamp and gain."""

    space = ParameterSpace({"gain": Float(low=0.0, high=9.0, baseline=1.0)})
    live, clean = True, True

    def __init__(self, wrong=lambda *_: None, parameters=None, refuses=()):
        super().__init__(parameters)
        self.wrong, self.refuses = wrong, refuses
        self.events = []

    def prepare(self, scan):
        return scan.stamp

    def start(self, prepared, T_odom_sensor, _motion=None):
        self.events.append(("start", round(prepared / TENTH)))
        self.T, self.at = T_odom_sensor, prepared

    def register(self, prepared):
        self.events.append(("register", round(prepared / TENTH)))
        step = STEP * (prepared - self.at) / TENTH
        wrong = self.wrong(round(prepared / TENTH), self.parameters["gain"])
        self.T, self.at = self.T.copy(), prepared
        self.T[0, 3] += step if wrong is None else wrong
        return Registration(self.T, registered=True)

    def configure(self, parameters):
        if parameters["gain"] in self.refuses:
            raise OdometryError("no such gain")
        super().configure(parameters)


class InTurns:
    """Chooses sets in turn."""

    def __init__(self, *gains):
        self.gains, self.n = gains, 0

    def observe(self, *_):
        pass

    def select(self):
        gain = self.gains[min(self.n, len(self.gains) - 1)]
        self.n += 1
        return Selection(round(gain), {"gain": gain})

    def measure(self):
        pass


def tenths(n):
    return [Scan(i * TENTH, np.zeros((0, 3), np.float32)) for i in range(n)]


def drive(odometry, selector, n=40, fixed=FIXED):
    return replay(tenths(n), InProcess(odometry), HEALTH, selector, what="home", fallback=fixed)


@pytest.mark.parametrize(
    ("wrong", "found"), [(math.nan, "no_pose"), (9.0, "max_speed"), (math.inf, "no_pose")]
)
def test_after_an_impossible_pose_the_fixed_set_is_used_with_a_warm_up(wrong, found, caplog):
    odometry = Fragile(lambda n, gain: wrong if gain == 2.0 and n >= 25 else None)
    result = drive(odometry, InTurns(1.0, 2.0))
    what = f"the health check found {found}"
    applied = [(c.stamp // TENTH, c.selection.trial, c.fallen_back) for c in result.choices]
    assert applied == [(0, 1, ""), (10, 2, ""), (20, 2, ""), (25, 0, what)]
    assert [(c.stamp // TENTH, c.why_not) for c in result.rejected] == [
        (30, "the odometry failed with it")
    ]
    assert f"home: {what} at 2.5 s; the fixed set is used" in caplog.text
    # It saw the last two seconds again, and goes on as if nothing had happened.
    at = odometry.events.index(("start", 4))
    assert odometry.events[at + 1 : at + 22] == [("register", n) for n in range(5, 26)]
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )
    assert result.restarted.sum() == 1


def test_a_set_is_tried_again_after_a_minute():
    odometry = Fragile(lambda n, gain: 9.0 if gain == 2.0 and n == 15 else None)
    result = drive(odometry, InTurns(1.0, 2.0), n=800)
    assert [c.stamp // TENTH for c in result.rejected] == list(range(20, 615, 10))
    assert result.choices[-1].selection.trial == 2


def test_where_the_fixed_set_is_in_use_the_odometry_restarts_as_ever():
    faults = [(Fragile(lambda n, _: 9.0 if n == 25 else None), s) for s in (InTurns(1.0), None)]
    of = [
        drive(odometry, selector, fixed=Selection(1, {"gain": 1.0}))
        for odometry, selector in faults
    ]
    np.testing.assert_array_equal(of[0].trajectory.T_world_sensor, of[1].trajectory.T_world_sensor)
    assert faults[0][0].events == faults[1][0].events
    assert of[0].restarted.sum() == 1


def test_where_the_baseline_has_just_been_taken_the_odometry_restarts_with_it():
    odometry = Fragile(lambda n, _: 9.0 if n == 25 else None)
    fixed = Selection(1, {"gain": 1.0})
    result = drive(odometry, InTurns(1.0, 1.0, 0.0), fixed=fixed)
    assert [(c.selection.trial, c.fallen_back) for c in result.choices][2:] == [(0, "")] * 2
    assert not result.rejected
    assert result.restarted.sum() == 1
    # Later, the fault is its own.
    odometry = Fragile(lambda n, gain: 9.0 if n == 25 and gain == 0.0 else None)
    result = drive(odometry, InTurns(0.0), fixed=fixed)
    assert result.choices[-1].fallen_back == "the health check found max_speed"
    assert [c.why_not for c in result.rejected] == ["the odometry failed with it"]


def test_where_the_warm_up_fails_too_it_begins_without_a_past():
    odometry = Fragile(lambda n, _: 9.0 if n == 25 else None)
    result = drive(odometry, InTurns(1.0, 2.0))
    assert odometry.events.count(("start", 4)) == odometry.events.count(("start", 25)) == 1
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )


def test_a_switch_that_fails_returns_to_the_fixed_set(caplog):
    odometry = Fragile(refuses=(2.0,))
    result = drive(odometry, InTurns(3.0, 2.0, 3.0))
    assert [c.selection.trial for c in result.choices] == [3, 0, 3, 3]
    assert [c.why_not for c in result.rejected] == ["no such gain"]
    assert "home: trial 2 cannot be applied: no such gain at 1.0 s" in caplog.text


def test_where_the_fixed_set_cannot_be_applied_either_the_last_set_stays(caplog):
    odometry = Fragile(refuses=(1.0, 2.0))
    result = drive(odometry, InTurns(3.0, 2.0))
    assert odometry.parameters["gain"] == 3.0
    assert [c.selection.trial for c in result.choices] == [3]
    assert "nor can the fixed set: no such gain" in caplog.text
    assert len(result.trajectory) == 40


def test_a_set_counts_from_when_it_is_confirmed_on(caplog):
    class Slow(InProcess):
        """Confirms a set, or refuses it, three scans later; never trial 2."""

        def apply(self, selection):
            super().apply(selection)
            self.trial, self.looks = selection.trial, 0

        def confirmed(self):
            self.looks += 1
            if self.trial == 3 and self.looks > 3:
                raise OdometryError("no such gain")
            return self.trial != 2 and self.looks > 3

    odometry = Slow(Fragile())
    selector = InTurns(1.0, 2.0, 3.0, 1.0)
    result = replay(tenths(33), odometry, HEALTH, selector, what="home", fallback=FIXED)
    why = "trial 3 cannot be applied: no such gain"
    found = [(c.stamp // TENTH, c.selection.trial, c.fallen_back) for c in result.choices]
    assert found == [(0, 1, ""), (22, 0, why), (30, 1, "")]
    assert [c.seconds for c in result.choices] == pytest.approx([0.2, 0.3, 0.2], abs=0.05)
    found = [(c.stamp // TENTH, c.selection.trial, c.why_not) for c in result.rejected]
    assert found == [(10, 2, "not confirmed in time"), (20, 3, "no such gain")]
    assert f"home: {why} at 2.2 s; the fixed set is used" in caplog.text


def test_without_a_fixed_set_a_switch_that_fails_is_an_error():
    with pytest.raises(OdometryError, match="no such gain"):
        drive(Fragile(refuses=(2.0,)), InTurns(2.0), fixed=None)


def test_a_bank_without_a_pose_gets_the_fixed_weights():
    def make(parameters):
        return InProcess(Fragile(lambda n, _: math.nan if n == 25 else None, parameters))

    bank = Bank(make, {0: {"gain": 1.0}, 2: {"gain": 2.0}})
    half = Selection(2, {"gain": 2.0}, {0: 0.2, 2: 0.8})
    fixed = Selection(0, {"gain": 1.0}, {0: 1.0, 2: 0.0})

    class Half(InTurns):
        def select(self):
            return half

    result = replay(tenths(40), bank, HEALTH, Half(), fallback=fixed)
    weights = [(c.stamp // TENTH, c.selection.weights[0]) for c in result.choices]
    # Members stay: those that failed have restarted.
    assert weights == [(0, 0.2), (10, 0.2), (20, 0.2), (25, 1.0), (30, 0.2)]
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )


def test_where_a_bank_that_rests_fails_all_join_in():
    made = []

    def make(parameters):
        one = Fragile(lambda n, gain: 9.0 if n == 25 and gain == 1.0 else None, parameters)
        made.append(one)
        return InProcess(one)

    bank = Bank(make, {0: {"gain": 1.0}, 2: {"gain": 2.0}})
    fixed = Selection(0, {"gain": 1.0}, {0: 1.0, 2: 0.0})

    class Alone(InTurns):
        def select(self):
            return fixed._replace(resting=frozenset({2}))

    result = replay(tenths(40), bank, HEALTH, Alone(), what="home", fallback=fixed)
    rested = [(c.stamp // TENTH, bool(c.selection.resting)) for c in result.choices]
    assert rested == [(0, True), (10, True), (20, True), (25, False), (30, True)]
    assert made[1].events[0] == ("start", 4)
    assert made[1].events[-1] == ("register", 29)
    np.testing.assert_allclose(
        result.trajectory.T_world_sensor[:, 0, 3], STEP * np.arange(40), atol=1e-9
    )


class LateToPose(InProcess):
    """Gives its first pose for the fourth scan."""

    n = 0

    @property
    def begun(self):
        return self.n >= 3

    def register(self, prepared):
        self.n += 1
        return super().register(prepared)


def test_a_late_first_pose_is_told_and_what_was_before_is_left_out(tmp_path, caplog):
    caplog.set_level("INFO")
    late = replay(scans(np.arange(40.0)), LateToPose(Scripted()), HEALTH)
    assert late.first_pose == 3.0
    folder = tmp_path / "hall" / "fixed-0"
    folder.mkdir(parents=True)
    write_run(folder, late, ABOUT)
    assert caplog.messages == ["hall, fixed: the odometry gave its first pose after 3.0 s"]
    stored = read_run(folder)
    assert stored.summary.first_pose == 3.0
    assert stored.summary.scans == len(stored.trajectory) == 37
    assert replay(scans(np.arange(40.0)), InProcess(Scripted()), HEALTH).first_pose == 0.0
