import csv
import json
from dataclasses import replace

import drives
import numpy as np
import pytest

from adaptune.descriptor import DescriptorError
from adaptune.descriptor.ndt import describe
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel, PairedFusion, Selection
from adaptune.odometry import Odometry, OdometryError, Registration
from adaptune.odometry.gicp import KeyframeGicp
from adaptune.odometry.health import HealthCheck
from adaptune.sequence import Scan
from adaptune.simulation import Course, simulate
from adaptune.space import Float, ParameterSpace
from adaptune.trajectory import read_tum
from online.replay import adaptive, replay, write_replay


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


HEALTH = HealthCheck(max_speed=5.0, max_acceleration=20.0)


def test_selects_at_the_first_scan_and_then_every_period_before_registering():
    box = Scripted()
    asked, moves = [], []

    def policy(scan, motion):
        moves.append(motion.tolist())
        asked.append(scan.stamp)
        return Selection(len(asked) % 2, 1.0, 2.0)

    stamps = [0.0, 0.4, 0.8, 1.0, 1.2, 1.9, 2.3, 4.95, 5.0, 5.05]
    result = replay(scans(stamps), box, HEALTH, policy, [{"speed": 3.0}, {"speed": 4.0}])
    assert [s / 1e9 for s in asked] == [0.0, 1.0, 2.3, 4.95, 5.0]
    assert [c.stamp for c in result.choices] == asked
    # From the last pose a second before the last one: 0.1 m a scan.
    speeds = [0, 0.2 / 0.8, 0.3 / (1.9 - 0.8), 0.2 / (2.3 - 1.2), 0.1 / (4.95 - 2.3)]
    np.testing.assert_allclose(moves, [[speed, 0.0] for speed in speeds], atol=1e-6)
    assert [c.parameters["speed"] for c in result.choices] == [4.0, 3.0, 4.0, 3.0, 4.0]
    # The change comes before the scan that it was made from.
    assert box.events[:2] == [("configure", 4.0), ("start", 0, 0.0, None)]
    at = box.events.index(("register", 1_000_000_000, 3.0))
    assert box.events[at - 1] == ("configure", 3.0)


def test_without_a_policy_nothing_is_changed():
    box = Scripted()
    result = replay(scans(np.arange(30) / 10), box, HEALTH)
    assert not [event for event in box.events if event[0] == "configure"]
    assert result.choices == []
    np.testing.assert_allclose(result.trajectory.T_world_sensor[:, 0, 3], np.arange(30) * 0.1)


@pytest.mark.parametrize("jump", [3.0, -2.0, np.nan, np.inf])
def test_an_impossible_step_starts_anew_at_the_last_healthy_motion(jump):
    box = Scripted([0.1, 0.2, jump, 0.2])
    result = replay(scans(np.arange(6) / 10), box, HEALTH)
    assert np.flatnonzero(result.restarted).tolist() == [3]
    x = result.trajectory.T_world_sensor[:, 0, 3]
    np.testing.assert_allclose(x, [0.0, 0.1, 0.3, 0.5, 0.7, 0.8])
    start = [event for event in box.events if event[0] == "start"][1]
    assert start[1] == 300_000_000
    assert start[2:] == pytest.approx((0.5, 0.2))


def test_an_impossible_turn_starts_anew():
    class Turning(Scripted):
        def register(self, prepared):
            T = super().register(prepared).T_odom_sensor
            if prepared == 300_000_000:
                T[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]  # 900 degrees a second
            return Registration(T)

    result = replay(scans(np.arange(6) / 10), Turning(), HEALTH)
    assert np.flatnonzero(result.restarted).tolist() == [3]
    np.testing.assert_allclose(result.trajectory.T_world_sensor[-1, :3, :3], np.eye(3))


def test_a_platform_that_did_change_its_motion_is_believed_in_the_end():
    # From 0.1 to 0.45 m a scan is 3.5 m/s at once; the bound grows with the time unseen.
    box = Scripted([0.1, 0.1, *[0.45] * 6])
    result = replay(scans(np.arange(9) / 10), box, HEALTH)
    assert np.flatnonzero(result.restarted).tolist() == [3]
    assert np.diff(result.trajectory.T_world_sensor[:, 0, 3])[-1] == pytest.approx(0.45)


def test_after_a_dropped_scan_the_last_motion_goes_on_for_longer():
    box = Scripted([0.1, 0.1, 50.0, 0.1])
    result = replay(scans([0.0, 0.1, 0.2, 0.5, 0.6]), box, HEALTH)
    assert result.restarted.tolist() == [False, False, False, True, False]
    x = result.trajectory.T_world_sensor[:, 0, 3]
    np.testing.assert_allclose(x, [0.0, 0.1, 0.2, 0.5, 0.6])
    (restart,) = [event for event in box.events if event[0] == "start"][1:]
    np.testing.assert_allclose(restart[2:], [0.5, 0.3])


def test_a_frozen_pose_starts_anew():
    box = Scripted([0.1, 0.1] + [0.0] * 6 + [0.1])
    check = HEALTH.model_copy(update={"max_freeze": 0.45})
    result = replay(scans(0.1 * np.arange(9)), box, check)
    assert np.flatnonzero(result.restarted).tolist() == [7]
    np.testing.assert_allclose(result.trajectory.T_world_sensor[7, 0, 3], 0.3)


def test_a_robot_that_comes_to_a_stand_has_not_frozen():
    box = Scripted([0.1, 0.08, 0.06, 0.04, 0.02] + [0.0] * 40)
    result = replay(scans(0.1 * np.arange(40)), box, HEALTH)
    assert not result.restarted.any()
    box = Scripted([0.0] * 40)
    assert not replay(scans(0.1 * np.arange(40)), box, HEALTH).restarted.any()


def test_poor_scans_are_counted(tmp_path):
    box = Scripted([0.1, None, 0.1])
    result = replay(scans(np.arange(5) / 10), box, HEALTH)
    assert result.registered.tolist() == [True, True, False, True, True]
    write_replay(tmp_path, result, {"mode": "x"})
    assert json.loads((tmp_path / "replay.json").read_text())["poor_scans"] == 1


def test_too_many_scans_that_do_not_register_start_anew(tmp_path):
    box = Scripted([0.1, 0.1, *[None] * 7, 0.1])
    check = HEALTH.model_copy(update={"max_unregistered": 3})
    result = replay(scans(np.arange(11) / 10), box, check)
    assert np.flatnonzero(result.restarted).tolist() == [5, 8]
    assert result.unhealthy == {"max_unregistered": 2}
    write_replay(tmp_path, result, {})
    told = json.loads((tmp_path / "replay.json").read_text())
    assert told["unhealthy"] == {"max_unregistered": 2}


def test_no_scans():
    with pytest.raises(AdaptuneError, match="no scan"):
        replay([], Scripted(), HEALTH)


def test_an_odometry_that_is_not_live_is_refused():
    class Stiff(Scripted):
        live = False

    with pytest.raises(OdometryError, match="cannot change its parameters"):
        replay(scans([0.0]), Stiff(), HEALTH, lambda *_: Selection(0, 1.0, 1.0), [{"speed": 1.0}])


def test_a_real_replay_is_the_same_every_time(tmp_path):
    drive = [Scan(stamp, points) for stamp, points, _ in drives.scans(0, 25)]
    sets = [
        {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0},
        {"max_correspondence_distance": 0.7, "keyframe_interval": 3.0},
    ]

    def policy(scan, _):
        return Selection(scan.stamp // 10**9 % 2, 0.5, 1.0)

    results = [replay(drive, KeyframeGicp(sets[0]), HealthCheck(), policy, sets) for _ in range(2)]
    a, b = (r.trajectory.T_world_sensor for r in results)
    np.testing.assert_array_equal(a, b)
    assert abs(a[-1, 0, 3] - 24 * 0.3) < 0.1
    write_replay(tmp_path, results[0], {})
    written = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(written.stamps, [stamp for stamp, _, _ in drives.scans(0, 25)])
    np.testing.assert_allclose(written.T_world_sensor, a, atol=1e-8)
    with (tmp_path / "selections.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["stamp_ns"]) for row in rows] == [c.stamp for c in results[0].choices]
    assert {row["predicted_error_percent"] for row in rows} == {"0.5000"}
    assert {float(row["keyframe_interval"]) for row in rows} == {1.0, 3.0}


def drive_cave(sensor, seed):
    course = Course(scenes=("cave",), length=10.0, sensor=sensor, seed=seed)
    return [Scan(s.stamp, s.points) for s in list(simulate(course))[::10]]


def of_two_caves():
    """Fitted to scans of an HDL-32E."""
    drives = [drive_cave("hdl32e", seed) for seed in (1, 2)]
    trained = [scan for drive in drives for scan in drive]
    return ErrorModel(
        odometry={"name": "gicp"},
        space=Scripted.space,
        sets=[{"speed": 1.0}, {"speed": 8.0}],
        fixed=0,
        length=25.0,
        sequences=["one", "two"],
        blocks={"ndt": 90},
        window=1,
        descriptors=np.stack([describe(scan) for scan in trained]),
        sequence=np.repeat([0, 1], [len(drive) for drive in drives]),
        errors=np.tile(np.float32([1.0, 0.1]), (len(trained), 1)),
        provenance={},
        elevations=[-30.7, -30.7],
        bank=[0, 1],
        vectors=np.zeros((len(trained), 2, 3), np.float32),
    )


def test_scans_of_another_sensor_get_the_fixed_set(caplog):
    """A cave looks alike to many sensors; what lies lowest does not."""
    model = of_two_caves()
    for sensor, chosen in (("hdl32e", 1), ("vlp16", 0)):
        select = adaptive(model, "paired")
        selections = [select(scan) for scan in drive_cave(sensor, 3)]
        assert np.mean([s.set_index == chosen for s in selections]) > 0.9
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "-15 degrees, those of training at -31" in caplog.text
    assert all(s.set_index == 0 and s.familiarity == 0.0 for s in selections)
    # The published rule has no such doubts.
    select = adaptive(model, "paper")
    assert all(select(scan).set_index == 1 for scan in drive_cave("vlp16", 3))


def test_motion_tells_places_apart():
    model = of_two_caves()
    # The one was driven through slowly, the other fast, and what is better differs.
    slowly = model.sequence == 0
    motion = np.column_stack([np.where(slowly, 0.5, 5.0), np.zeros(len(slowly))])
    model = replace(
        model,
        descriptors=np.hstack([model.descriptors, motion]).astype(np.float32),
        blocks={"ndt": 90, "motion": 2},
        errors=np.where(slowly[:, None], [0.1, 1.0], [1.0, 0.1]).astype(np.float32),
    )
    select = adaptive(model, "paper")
    (scan, *_) = drive_cave("hdl32e", 3)
    chosen = [select(scan, np.array([speed, 0.0])).set_index for speed in (0.5, 5.0)]
    assert chosen == [0, 1]
    with pytest.raises(DescriptorError, match="`motion`, too: tell speed and turn rate"):
        select(scan)


def test_a_banks_weights_change_slowly(monkeypatch):
    found = [(1.0, 0.0), (0.0, 1.0), (0.0, 1.0), (0.5, 0.5), (0.0, 1.0), (0.0, 1.0), (0.0, 1.0)]
    model, left = of_two_caves(), []

    def select(*_):
        weights = left.pop(0) if left else (1.0, 0.0)
        return Selection(int(np.argmax(weights)), 0.2, 1.0, 1.0, 2.0, weights)

    monkeypatch.setattr(PairedFusion, "select", select)
    policy = adaptive(model, "paired", members=[0, 1])
    left[:] = found
    selections = [policy(scan) for scan in drive_cave("hdl32e", 3)[: len(found)]]
    for i, selection in enumerate(selections):
        mean = np.mean(found[max(0, i - 4) : i + 1], axis=0)
        np.testing.assert_allclose(selection.weights, mean)
        assert selection.set_index == np.argmax(mean)
    # So does a place that is unlike all training, though not for long.
    strange = Selection(0, 1.0, 1.0, 0.0, 2.0, (1.0, 0.0))
    monkeypatch.setattr(PairedFusion, "select", lambda *_: strange)
    assert policy(drive_cave("hdl32e", 3)[0]).weights == (1.0, 0.0)
    monkeypatch.setattr(PairedFusion, "select", select)
    left[:] = [(0.0, 1.0)]
    np.testing.assert_allclose(policy(drive_cave("hdl32e", 3)[0]).weights, [0.2, 0.8])
    # Another sensor leaves the fixed set all the weight, and at once.
    policy = adaptive(model, "paired", members=[0, 1])
    left[:] = found[1:3]
    for scan in drive_cave("vlp16", 3)[:2]:
        assert policy(scan).weights == (1.0, 0.0)
