import dataclasses
from itertools import islice
from typing import ClassVar

import drives
import numpy as np
import pytest
from setups import made_of, setup_of

from adaptune.errors import AdaptuneError
from adaptune.geometry import invert
from adaptune.metrics import sub_trajectory_rte
from adaptune.odometry import Registration
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.recording import SequenceConfig
from adaptune.recording.scan import Scan
from adaptune.trajectory import Trajectory
from offline.config import load_study
from offline.trial import SharedScans, TrialSettings, reference_poses
from online.replay import replay

GOOD = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}


@pytest.fixture(scope="module")
def study(study_file, tmp_path_factory):
    return load_study(study_file, [], tmp_path_factory.mktemp("run"))


def test_a_good_trial(study):
    sequence = setup_of(study).prepare("one", 1e9)
    (trial,) = setup_of(study).run(sequence, [GOOD])
    assert trial.parameters == GOOD
    assert not trial.restarted.any()
    assert trial.registered.all()
    assert trial.mean_error < 2.0
    # 39 steps of 0.3 m: sub-trajectories of more than 3 m start at the first 29 frames.
    assert np.flatnonzero(~np.isnan(trial.errors)).tolist() == list(range(29))
    expected = sub_trajectory_rte(sequence.frames.T_ref_sensor, trial.T_odom_sensor, 3.0)
    np.testing.assert_array_equal(trial.errors, expected)


def test_motion_is_described_by_the_reference_before_each_scan(study_file, tmp_path):
    study = load_study(study_file, ["descriptor=[ndt, motion]"], tmp_path)
    frames = setup_of(study).prepare("one", 1e9).frames
    assert frames.blocks == {"ndt": 90, "motion": 2}
    np.testing.assert_allclose(frames.descriptors[:2, 90], 0.0)
    # 0.3 m a scan, ten scans a second.
    np.testing.assert_allclose(frames.descriptors[2:, 90], 3.0, rtol=0.1)
    assert frames.descriptors[:, :90].any()


def test_trials_side_by_side_are_those_one_by_one(study):
    sequence = setup_of(study).prepare("one", 1e9)
    sets = [GOOD, GOOD | {"keyframe_interval": 5.0}, GOOD | {"max_correspondence_distance": 0.2}]
    together = setup_of(study).run(sequence, sets)
    for parameters, trial in zip(sets, together, strict=True):
        (alone,) = setup_of(study).run(sequence, [parameters])
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


def test_a_lost_track_starts_anew_at_the_reference(study):
    instances = []
    setup = setup_of(study, made_of(Slipping, study, instances))
    sequence = setup.prepare("one", 1e9)
    (trial,) = setup.run(sequence, [GOOD])
    frames = sequence.frames
    # 3 m/s at 10 Hz bounds a step's departure by 0.3 m: the second slip is none.
    assert 10 in np.flatnonzero(trial.restarted)
    assert 25 not in np.flatnonzero(trial.restarted)
    np.testing.assert_array_equal(trial.T_odom_sensor[10], frames.T_ref_sensor[10])
    _, T, motion = next(s for s in instances[-1].starts if s[0] == 10 and s[2] is not None)
    np.testing.assert_array_equal(T, frames.T_ref_sensor[10])
    np.testing.assert_allclose(
        motion, invert(frames.T_ref_sensor[9]) @ frames.T_ref_sensor[10], atol=1e-12
    )


def test_windows_with_a_lost_track_are_failures_and_the_others_sound(study):
    class Lost(Slipping):
        slips: ClassVar = {10: 5.0, 11: -5.0}

    setup = setup_of(study, made_of(Lost, study))
    sequence = setup.prepare("one", 1e9)
    (trial,) = setup.run(sequence, [GOOD])
    assert np.flatnonzero(trial.restarted).tolist() == [10]
    # Eleven steps of 0.3 m are more than 3 m: windows from -1 (none) to 9 cross the step to 10.
    assert np.flatnonzero(np.isinf(trial.errors)).tolist() == list(range(10))
    assert trial.errors[10:29].max() < 3.0
    assert trial.mean_error == pytest.approx((10 * 30.0 + trial.errors[10:29].sum()) / 29)
    assert trial.metrics["rpe"] == pytest.approx(5.0 / np.sqrt(39), rel=0.02)
    assert trial.metrics["ape"] > 1.0
    # What the odometry did counts, not the new start.
    assert trial.unhealthy == {"max_speed": 1}
    (whole,) = setup.run(sequence, [GOOD], whole=True)
    assert not whole.restarted.any()
    assert np.isfinite(whole.errors[:29]).all()
    # It is driven as a replay drives it.
    scans = study.sequences.open("one")
    replayed = replay(scans, made_of(Lost, study)(GOOD), study.config.health)
    assert whole.unhealthy == replayed.unhealthy == {"max_speed": 1}
    np.testing.assert_array_equal(whole.T_odom_sensor, replayed.trajectory.T_world_sensor)
    assert whole.health == study.config.health.model_dump()


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
@pytest.mark.parametrize("whole", [False, True])
def test_an_exception_is_a_fault_of_its_trial(study, where, whole):
    unable = type("Unable", (Unable,), {"where": where})
    setup = setup_of(study, made_of(unable, study))
    sequence = setup.prepare("one", 1e9)
    sets = [GOOD | {"keyframe_interval": 7.0}, GOOD]
    bad, good = setup.run(sequence, sets, whole)
    (fault,) = bad.faults
    assert "ValueError: seven planes" in fault
    assert not good.faults
    first = 20 if where == "register" else 1
    assert not bad.registered[first:].any()
    if whole:
        assert bad.unhealthy["no_pose"] == len(bad.errors) - first + (where != "register")
    else:
        assert np.isinf(bad.errors[first:29]).all()
        assert bad.mean_error > good.mean_error


def test_repeats_are_averaged_and_kept(study):
    made = []

    class Wavering(Slipping):
        """Of three instances that run, the second drifts to the side, the third loses track."""

        def __init__(self, *args):
            super().__init__(*args)
            made.append(self)
            drift, loss = dict.fromkeys(range(40), 0.01), {10: 5.0, 11: -5.0}
            self.slips = {3: drift, 4: loss}.get(len(made), {})

    wavering = made_of(Wavering, study)
    sequence = setup_of(study, wavering).prepare("one", 1e9)
    (trial,) = setup_of(study, wavering, repeats=3).run(sequence, [GOOD])
    assert len(made) == 4
    errors = [of_run["rte"] for of_run in trial.repeats]
    assert errors[0] < errors[1] < errors[2]
    assert trial.mean_error == pytest.approx(np.mean(errors))
    assert trial.errors[5] > 10.0
    assert np.flatnonzero(trial.restarted).tolist() == [10]
    assert trial.metrics["ape"] == pytest.approx(np.mean([r["ape"] for r in trial.repeats]))
    (alone,) = setup_of(study, wavering).run(sequence, [GOOD])
    np.testing.assert_array_equal(trial.T_odom_sensor, alone.T_odom_sensor)


@pytest.mark.parametrize("part", [None, (0.0, 0.3)])
def test_a_path_that_is_too_short_is_told(study, tmp_path, part):
    bag, name = tmp_path / "hall.bag", "hall" if part is None else "hall_0-30"
    drives.write_bag(bag, drives.scans(0, 9 if part is None else 40))
    config = SequenceConfig(bag=str(bag), points="/points", reference="/truth", part=part)
    sequences = dataclasses.replace(study.sequences, recordings={name: config})
    settings = TrialSettings(sub_trajectory=3.0 if part is None else 9.0)
    setup = dataclasses.replace(setup_of(study), sequences=sequences, settings=settings)
    key = r"sequences\.hall" if part is None else r"\[hall: 0-30%\]"
    with pytest.raises(AdaptuneError, match=rf"^{key}: its path of .* holds no sub-trajectory"):
        setup.prepare(name, 1e9)


def test_a_reference_with_too_few_poses_names_max_gap():
    stamps = np.round(np.arange(20) * 1.4e9).astype(np.int64)
    T = np.tile(np.eye(4), (20, 1, 1))
    T[:, 0, 3] = np.arange(20)
    scans, settings = np.arange(0, 26 * 10**9, 10**8) + 1, TrialSettings(sub_trajectory=5.0)
    with pytest.raises(AdaptuneError, match=r"^sequences\.one: 19 of 19 gaps .*`max_gap: 1\.5`"):
        reference_poses("sequences.one", Trajectory(stamps, T), scans, settings)
    assert reference_poses("", Trajectory(stamps, T, 1.5), scans, settings).shape == (260, 4, 4)


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

    count = 0

    def __iter__(self):
        for stamp in range(N):
            self.count += 1
            yield Scan(stamp, np.zeros((1, 3), np.float32))


def passes(shared, *instances):
    """What each instance gets on a pass."""
    return [[int(scan(one)[0]) for one in instances] for scan in islice(shared, N)]


def test_each_scan_is_prepared_once_for_all_that_are_alike():
    read = Read()
    shared = SharedScans(read, 1e6)
    one, alike, other = Preparer("a"), Preparer("a"), Preparer("b")
    assert passes(shared, one, alike, other) == [[i, i, i] for i in range(N)]
    assert (one.count, alike.count, other.count) == (N, 0, N)
    assert read.count == N
    # Nothing is read or prepared again.
    assert passes(shared, alike, other) == [[i, i] for i in range(N)]
    assert (one.count, other.count, read.count) == (N, N, N)
    assert shared.nbytes == 2 * N * SIZE


def test_what_memory_does_not_hold_is_read_again():
    read = Read()
    shared = SharedScans(read, 2.5 * SIZE)
    one = Preparer("a")
    assert passes(shared, one) == passes(shared, one) == [[i] for i in range(N)]
    assert shared.nbytes == 2 * SIZE
    assert one.count == N + (N - 2)
    assert read.count == 2 * N


def test_preparations_that_a_pass_does_not_use_make_room():
    shared = SharedScans(Read(), N * SIZE)
    one, other = Preparer("a"), Preparer("b")
    passes(shared, one)
    passes(shared, other)
    # The first scan found no room.
    assert (shared.n_kept(one), shared.n_kept(other)) == (0, N - 1)
    # Of two that are used, none makes room for the other.
    passes(shared, one, other)
    assert (shared.n_kept(one), shared.n_kept(other)) == (1, N - 1)


@pytest.mark.parametrize(
    ("name", "settings", "given", "runs"),
    [
        ("rustle", {"play": "lockstep"}, None, "whole"),
        ("rustle", {"play": "lockstep"}, "restart", "restart"),
        ("rustle", {}, None, "restart"),
        ("gicp", {}, None, "restart"),
    ],
)
def test_trials_run_on_where_a_start_is_a_new_container(study_file, name, settings, given, runs):
    config = load_study(study_file).config
    odometry = config.odometry.model_copy(update={"name": name, "settings": settings})
    offline = config.offline.model_copy(update={"runs": given})
    changed = config.model_copy(update={"odometry": odometry, "offline": offline})
    assert changed.runs == TrialSettings.of(changed).runs == runs
    assert changed.search_inputs["runs"] == runs
