import dataclasses
import re
from itertools import islice
from typing import ClassVar

import drives
import numpy as np
import pytest
from made_drives import described, trials_of
from setups import made_of, setup_of

from adaptune.errors import AdaptuneError
from adaptune.geometry import invert
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.odometry import Registration
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording import SequenceConfig
from adaptune.recording.scan import Scan, SequenceError
from adaptune.reference.judge import Reference
from adaptune.runs.loop import replay
from adaptune.trajectory import Trajectory
from offline.config import OfflineConfig, load_study
from offline.frames import Segment, reference_poses, segments_of
from offline.shared_scans import SharedScans

GOOD = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}


@pytest.fixture(scope="module")
def study(study_file, tmp_path_factory):
    return load_study(study_file, [], tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def short(study_file, tmp_path_factory):
    """The same with four segments of each sequence."""
    given = ["sub_trajectory=0.3", "offline.segments=4"]
    return load_study(study_file, given, tmp_path_factory.mktemp("run"))


def test_a_good_trial(study):
    frames = described(setup_of(study))
    (trial,) = trials_of(setup_of(study), [GOOD], frames=frames)
    assert trial.parameters == GOOD
    assert not trial.restarted.any()
    assert not trial.failure
    assert trial.mean_error < 2.0
    # 39 steps of 0.3 m: sub-trajectories of more than 3 m start at the first 29 frames. It begins
    # in motion, and counts from there, as a replay does.
    assert np.flatnonzero(~np.isnan(trial.errors)).tolist() == list(range(29))
    expected = sub_trajectory_rte(frames.counted, trial.T_odom_sensor, 3.0)
    np.testing.assert_array_equal(trial.errors, expected)


def test_trials_side_by_side_are_those_one_by_one(study):
    sets = [GOOD, GOOD | {"keyframe_interval": 5.0}, GOOD | {"max_correspondence_distance": 0.2}]
    together = trials_of(setup_of(study), sets)
    for parameters, trial in zip(sets, together, strict=True):
        (alone,) = trials_of(setup_of(study), [parameters])
        np.testing.assert_array_equal(trial.T_odom_sensor, alone.T_odom_sensor)
    assert not np.array_equal(together[0].T_odom_sensor, together[1].T_odom_sensor)


class Slipping(KeyframeGicp):
    """Loses track by a given distance at given scans, and stays beside the track."""

    slips: ClassVar = {10: 0.31, 25: 0.29}

    def __init__(self, *args):
        super().__init__(*args)
        self.scan = 0
        self.slip = np.eye(4)
        self.starts = []

    def start(self, prepared, T_odom_sensor, T_previous_current=None):
        self.starts.append((self.scan, T_odom_sensor, T_previous_current))
        super().start(prepared, T_odom_sensor, T_previous_current)

    def register(self, prepared):
        self.scan += 1
        T, ok = super().register(prepared)
        self.slip[1, 3] += self.slips.get(self.scan, 0.0)
        return Registration(T @ self.slip, ok)


class Lost(Slipping):
    slips: ClassVar = {10: 5.0, 11: -5.0}


def test_a_trial_is_a_drive_with_the_health_check(study):
    setup = setup_of(study, made_of(Lost, study))
    frames = described(setup)
    (trial,) = trials_of(setup, [GOOD], frames=frames)
    scans = study.sequences.open("one")
    replayed = replay(scans, made_of(Lost, study)(GOOD), study.config.health)
    assert replayed.unhealthy == {"max_speed": 1}
    np.testing.assert_array_equal(trial.T_odom_sensor, replayed.trajectory.T_world_sensor)
    assert np.flatnonzero(trial.restarted).tolist() == [10]
    assert np.isfinite(trial.errors[8:29]).all()
    (whole,) = trials_of(setup, [GOOD], frames=frames.uncut)
    np.testing.assert_array_equal(whole.T_odom_sensor, trial.T_odom_sensor)


def test_a_trial_and_a_replay_have_the_same_errors_but_for_the_warm_up(short):
    scans = short.sequences.open("one")
    run = replay(scans, short.odometry(GOOD), short.config.health)
    expected = Reference(scans.reference(), 0.3).errors(run.trajectory)
    frames = described(setup_of(short))
    (whole,) = trials_of(setup_of(short), [GOOD], frames=frames.uncut)
    np.testing.assert_array_equal(cap(whole.errors), expected)
    # A segment within the recording begins at the reference, and its first scans do not count.
    (trial,) = trials_of(setup_of(short), [GOOD], frames=frames)
    (_, _, end), (first, begin, _), *_ = frames.segments
    known = np.flatnonzero(np.isfinite(trial.errors[:end]))
    np.testing.assert_array_equal(cap(trial.errors[known]), expected[known])
    assert first < begin
    assert np.isnan(trial.errors[first:begin]).all()
    assert np.isfinite(expected[first:begin]).all()


def test_each_segment_begins_at_the_reference_and_in_motion(short):
    instances = []
    setup = setup_of(short, made_of(Slipping, short, instances))
    frames = described(setup)
    (trial,) = trials_of(setup, [GOOD], frames=frames)
    segments = frames.segments
    assert len(segments) == 4
    T_ref_sensor, starts = frames.T_ref_sensor, [one.starts[0] for one in instances]
    assert len(starts) == 4
    for (first, begin, end), (_, T, motion) in zip(segments[1:], starts[1:], strict=True):
        np.testing.assert_array_equal(T, T_ref_sensor[first])
        np.testing.assert_allclose(
            motion, invert(T_ref_sensor[first - 1]) @ T_ref_sensor[first], atol=1e-3
        )
        assert end == 40 or np.isnan(trial.T_odom_sensor[end]).all()
        known = ~np.isnan(trial.errors[first:end])
        assert not known[: begin - first].any()
        assert known[begin - first :].any()
    (whole,) = trials_of(setup, [GOOD], frames=frames.uncut)
    assert np.isfinite(whole.T_odom_sensor).all()
    assert np.count_nonzero(~np.isnan(whole.errors)) > np.count_nonzero(~np.isnan(trial.errors))


class FailsOnce(KeyframeGicp):
    """Cannot begin on its second segment."""

    made: ClassVar = []

    def start(self, *args):
        self.made.append(self)
        if len(self.made) == 2:
            raise ValueError("seven planes")
        super().start(*args)


def test_a_drive_that_fails_at_its_first_scan_counts_as_lost(short):
    setup = setup_of(short, made_of(FailsOnce, short))
    frames = described(setup)
    (trial,) = trials_of(setup, [GOOD], frames=frames)
    for i, (_, begin, end) in enumerate(frames.segments):
        known = trial.errors[begin:end][~np.isnan(trial.errors[begin:end])]
        assert len(known)
        assert np.isinf(known).all() == (i == 1)
    assert "seven planes" in trial.reasons[0]
    assert trial.failure.startswith("no pose for ")


@pytest.mark.parametrize(
    ("metres", "n", "many"), [(400.0, 12, 12), (120.0, 12, 1), (400.0, None, 1)]
)
def test_segments_are_spread_evenly_along_the_path(metres, n, many):
    stamps = np.arange(4000) * 10**8
    T = np.tile(np.eye(4), (4000, 1, 1))
    # It stands for half of the time.
    T[:, 0, 3] = np.concatenate([np.zeros(2000), np.linspace(0.0, metres, 2000)])
    found = segments_of(T, stamps, 5.0, n)
    assert len(found) == many
    if many == 1:
        assert found.tolist() == [[0, 0, 4000]]
        return
    firsts, begins, ends = found.T
    assert (firsts <= begins).all()
    assert (begins < ends).all()
    assert (firsts[1:] >= ends[:-1]).all()
    assert ends[-1] > 3950
    np.testing.assert_allclose(np.diff(T[begins, 0, 3]), (metres - 15.15) / 11, atol=0.3)
    # The same number of sub-trajectories begins along each.
    of_segment = T[ends - 1, 0, 3] - T[begins, 0, 3]
    np.testing.assert_allclose(of_segment, 15.1, atol=0.3)


def test_a_recording_that_begins_in_motion_counts_from_its_first_scan():
    stamps, T = np.arange(200) * 10**8, np.tile(np.eye(4), (200, 1, 1))
    T[:, 0, 3] = 0.3 * np.arange(200)
    assert segments_of(T, stamps, 5.0, None).tolist() == [[0, 0, 200]]


class Slow(KeyframeGicp):
    """Takes ten seconds of CPU time a scan, as far as it says."""


def test_a_set_that_is_too_slow_is_stopped(study):
    setup = setup_of(study, made_of(Slow, study))
    (slow,) = trials_of(setup, [GOOD], most=0.0)
    (good,) = trials_of(setup, [GOOD], most=1e6)
    (ms,) = re.findall(r"too slow: (\d+) ms a scan", slow.failure)
    assert int(ms) == round(slow.others["register_ms"])
    assert int(ms) < 1e3  # of the one scan that it was given
    assert (slow.T_odom_sensor[2:] == slow.T_odom_sensor[1]).all()
    # Wherever it is stopped, it has the same errors.
    np.testing.assert_array_equal(np.isinf(slow.errors), np.isfinite(good.errors))
    assert not good.failure


def test_a_scan_that_cannot_be_read_is_no_fault_of_the_odometry(study):
    setup = setup_of(study)

    class Gone:
        name = "one.bag"

        def since(self, stamp):
            yield from islice(study.sequences.open("one").since(stamp), 20)
            raise OSError("the disk is gone")

    with pytest.raises(SequenceError, match=r"one\.bag: cannot be read .*the disk is gone.*again"):
        trials_of(setup, [GOOD], scans=Gone())


class Unable(KeyframeGicp):
    """Raises with one set, in its constructor or later."""

    where = "__init__"

    def __init__(self, *args):
        super().__init__(*args)
        self.scan = 0
        self.may_raise("__init__")

    def start(self, *args):
        self.may_raise("start")
        super().start(*args)

    def register(self, prepared):
        self.scan += 1
        if self.scan == 20:
            self.may_raise("register")
        return super().register(prepared)

    def may_raise(self, where):
        if self.where == where and self.parameters["keyframe_interval"] == 7.0:
            raise ValueError("seven planes")


@pytest.mark.parametrize("where", ["__init__", "start", "register"])
def test_an_exception_is_a_fault_of_its_trial(study, where):
    unable = type("Unable", (Unable,), {"where": where})
    setup = setup_of(study, made_of(unable, study))
    frames = described(setup)
    sets = [GOOD | {"keyframe_interval": 7.0}, GOOD]
    bad, good = trials_of(setup, sets, frames=frames)
    (fault,) = bad.reasons
    assert "ValueError: seven planes" in fault
    assert not good.faults
    first = 20 if where == "register" else 1
    assert (bad.T_odom_sensor[first:] == bad.T_odom_sensor[first - 1]).all()
    n = len(bad.errors)
    assert bad.failure == f"no pose for {n - first + (where != 'register')} of {n} scans"
    assert bad.mean_error > good.mean_error


def test_repeats_are_averaged_and_kept(study):
    made = []

    class Wavering(Slipping):
        """Of three instances that run, the second drifts to the side, the third jumps."""

        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)
            drift, loss = dict.fromkeys(range(40), 0.01), {10: 5.0, 11: -5.0}
            self.slips = {2: drift, 3: loss}.get(len(made), {})

    wavering = made_of(Wavering, study)
    (trial,) = trials_of(setup_of(study, wavering, repeats=3), [GOOD])
    assert len(made) == 3
    errors = [of_run["rte"] for of_run in trial.repeats]
    assert errors[1] > max(errors[0], errors[2]) + 1.0
    assert errors[0] != errors[2]
    assert trial.mean_error == pytest.approx(np.mean(errors))
    assert np.flatnonzero(trial.restarted).tolist() == [10]
    assert trial.metrics["ape"] == pytest.approx(np.mean([r["ape"] for r in trial.repeats]))
    (alone,) = trials_of(setup_of(study, wavering), [GOOD])
    np.testing.assert_array_equal(trial.T_odom_sensor, alone.T_odom_sensor)


@pytest.mark.parametrize("part", [None, (0.0, 0.3)])
def test_a_path_that_is_too_short_is_told(study, tmp_path, part):
    bag, name = tmp_path / "hall.bag", "hall" if part is None else "hall_0-30"
    drives.write_bag(bag, drives.scans(0, 9 if part is None else 40))
    given = SequenceConfig(bag=str(bag), points="/points", reference="/truth", part=part)
    sequences = dataclasses.replace(study.sequences, recordings={name: given})
    config = study.config.model_copy(update={"sub_trajectory": 3.0 if part is None else 9.0})
    setup = setup_of(study)._replace(sequences=sequences, config=config)
    key = r"sequences\.hall" if part is None else r"\[hall: 0-30%\]"
    with pytest.raises(AdaptuneError, match=rf"^{key}: its path of .* holds no sub-trajectory"):
        described(setup, name)


def test_a_reference_with_too_few_poses_names_max_gap(study):
    stamps = np.round(np.arange(20) * 1.4e9).astype(np.int64)
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = np.arange(20)
    scans = np.arange(0, 26 * 10**9, 10**8) + 1
    config = study.config.model_copy(update={"sub_trajectory": 5.0})
    with pytest.raises(AdaptuneError, match=r"^sequences\.one: 19 of 19 gaps .*`max_gap: 1\.5`"):
        reference_poses("sequences.one", Trajectory(stamps, T), scans, config)
    assert reference_poses("", Trajectory(stamps, T, 1.5), scans, config).shape == (260, 4, 4)


N, SIZE = 5, 1000


class Preparer(OdometryInstance):
    """Prepares scans to arrays of `SIZE` bytes, and counts them."""

    def __init__(self, key):
        self.key, self.count = key, 0

    @property
    def preparation(self):
        return self.key

    def prepare(self, scan):
        self.count += 1
        return np.full(SIZE, scan.stamp, np.uint8)

    def start(self, *_):
        raise AssertionError


class Read:
    """Scans that count how often they are read."""

    name, count = "read", 0

    def since(self, stamp):
        for at in range(stamp, N):
            self.count += 1
            yield Scan(at, np.zeros((1, 3), np.float32))


def along(first=0):
    return Segment("one", first, np.arange(first, N), np.eye(4), None)


def passes(shared, read, *instances, segment=None):
    """What each instance gets on a pass."""
    segment = segment or along()
    return [[int(scan(one)[0]) for one in instances] for scan in shared.along(segment, read)]


def test_each_scan_is_prepared_once_for_all_that_are_alike():
    read, shared = Read(), SharedScans(1e6)
    one, alike, other = Preparer("a"), Preparer("a"), Preparer("b")
    assert passes(shared, read, one, alike, other) == [[i, i, i] for i in range(N)]
    assert (one.count, alike.count, other.count) == (N, 0, N)
    assert read.count == N
    # Nothing is read or prepared again.
    assert passes(shared, read, alike, other) == [[i, i] for i in range(N)]
    assert (one.count, other.count, read.count) == (N, N, N)
    assert shared.nbytes == 2 * N * SIZE
    # Only the scans of a segment are read.
    assert passes(shared, read, one, segment=along(3)) == [[3], [4]]
    assert read.count == N + 2


def test_what_memory_does_not_hold_is_read_again_once_for_all():
    read, shared = Read(), SharedScans(2.5 * SIZE)
    one, alike = Preparer("a"), Preparer("a")
    for _ in range(2):
        assert passes(shared, read, one, alike) == [[i, i] for i in range(N)]
    assert shared.nbytes == 2 * SIZE
    assert (one.count, alike.count) == (N + (N - 2), 0)
    assert read.count == 2 * N


def test_what_was_asked_for_longest_ago_makes_room():
    read, shared = Read(), SharedScans(N * SIZE)
    one, other = Preparer("a"), Preparer("b")
    for _ in range(2):
        passes(shared, read, one)
    passes(shared, read, other)
    assert one.count == other.count == N
    # Asked for once, it may not come again; at the second time it is kept.
    for _ in range(3):
        passes(shared, read, other)
    assert (other.count, shared.nbytes) == (2 * N, N * SIZE)
    passes(shared, read, one)
    assert one.count == 2 * N


def test_what_is_driven_by_turns_and_does_not_fit_together_stays():
    read, shared = Read(), SharedScans(2 * N * SIZE)
    three = [Preparer(name) for name in "abc"]
    for _ in range(5):
        for one in three:
            passes(shared, read, one)
    assert sorted(one.count for one in three) == [N, N, 5 * N]


def test_scans_that_are_others_than_before_are_refused():
    segment = along()._replace(stamps=np.array([0, 1, 3, 9]))
    with pytest.raises(SequenceError, match="read: has other scans than before; run the same"):
        passes(SharedScans(1e6), Read(), Preparer("a"), segment=segment)


@pytest.mark.parametrize(
    ("name", "offline", "n"),
    [
        ("gicp", {}, 6),
        ("gicp", {"segments": 100}, 50),
        ("gicp", {"segments": 2}, 4),
        ("gicp", {"segments": "all"}, None),
        ("gicp", {"objective": "kitti"}, None),
        ("command", {}, None),
    ],
)
def test_how_many_segments_are_driven(study_file, name, offline, n):
    config = load_study(study_file).config
    odometry = config.odometry.model_copy(update={"name": name})
    given = OfflineConfig.model_validate(offline)
    changed = config.model_copy(update={"odometry": odometry, "offline": given})
    assert changed.segments == n
    assert changed.search_inputs["segments"] == (n or "all")
