"""Replays as recordings to look at."""

import re
import resource
from contextlib import contextmanager
from types import SimpleNamespace

import drives
import numpy as np
import pytest
from commands import call, refused, succeeded
from made_replays import folder_of
from rosbags.highlevel import AnyReader

from adaptune.geometry import invert
from adaptune.model import BankSettings
from adaptune.odometry.tracker import RegisteredScan
from adaptune.runs.files import StoredReplayError, write_run
from adaptune.runs.record import Choice, Run
from adaptune.space import Selection
from adaptune.trajectory import Trajectory
from offline.config import load_study
from online.modes import Replays
from online.recordings import record_replays, topic
from online.reference import reference_folder, write_reference

N = 40
STAMPS = drives.FIRST_STAMP + np.arange(N) * 100_000_000
FIXED = {"max_correspondence_distance": 2.5, "kernel": "huber"}


def along_x(drift=0.0):
    T = np.tile(np.eye(4), (N, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = 0.3 * np.arange(N), drift * np.arange(N)
    return Trajectory(STAMPS, T)


def replay_of(trajectory, choices=(), **record):
    steps = [
        RegisteredScan(stamp, T, True, "max_speed" if i == 7 else None, i * 1e-3, i * 2e-3)
        for i, (stamp, T) in enumerate(
            zip(trajectory.stamps.tolist(), trajectory.T_world_sensor, strict=True)
        )
    ]
    made = Run(steps=steps, cpu_ms=1.0, memory=1.0, **record)
    for choice in choices:
        made.note(choice)
    return made


def selections():
    for i in range(4):
        estimated = (np.nan,) * 3 if i == 0 else (1.0 + i, 0.5, 3.0)
        chosen = Selection(
            2 if i < 2 else 5,
            {"max_correspondence_distance": 1.0 + i, "kernel": ["none", "huber"][i % 2]},
            predicted_error=0.7,
            predicted_fixed=0.9,
            similarity=0.25,
            weights={2: 0.75, 5: 0.25},
            estimated_error=estimated[0],
            estimated_low=estimated[1],
            estimated_high=estimated[2],
            state="lost" if i == 2 else "good",
        )
        yield Choice(int(STAMPS[10 * i]), chosen, 0.004 * (i + 1))


@pytest.fixture
def study(study_file, tmp_path, monkeypatch):
    """A study with replays that were made up, of parameters that its odometry does not have."""
    study = load_study(study_file, [], tmp_path / "run")
    # Of a model, there is only one here.
    about = {"fixed": 1, "sets": {0: {}, 1: FIXED}, "bank": [1, 0], "recommended": "fixed"}
    about |= {"digest": "x", "bank_size": 9, "bank_settings": BankSettings(), "costs": None}
    model = SimpleNamespace(**about)
    monkeypatch.setattr("online.recordings.Replays.of", lambda study: Replays(study, model))
    replays = Replays(study, model)
    in_time = {"rate": 1.0, "late": [0.02] * N}
    for mode, made in (
        ("baseline", replay_of(along_x(0.02))),
        ("fixed", replay_of(along_x(0.01))),
        ("adaptive", replay_of(along_x(0.005), list(selections()), **in_time)),
    ):
        write_run(replays.folder("three", mode), made, replays.inputs("three", mode))
    elsewhere = np.eye(4)
    elsewhere[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    elsewhere[:3, 3] = 5.0, -3.0, 1.0
    reference = Trajectory(STAMPS, elsewhere @ along_x().T_world_sensor)
    write_reference(reference_folder(study, "three"), reference, along_x())
    return study


def left(study):
    return sorted(str(p.relative_to(study.folder)) for p in study.folder.rglob("*") if p.is_file())


def messages(folder):
    """Stamp and message of all topics."""
    found = {}
    with AnyReader([folder]) as reader:
        last = 0
        for connection, stamp, raw in reader.messages():
            assert stamp >= last
            last = stamp
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def numbers(found, name):
    return [stamp for stamp, _ in found[name]], [message.data for _, message in found[name]]


def test_an_mcap_holds_what_foxglove_shows(study):
    file = record_replays(study, "three")
    assert file == study.folder / "recordings/three/three.mcap"
    found = messages(file.parent)
    assert [len(found[name]) for name in ("/points", "/tf")] == [4, N]
    for mode, drift in (
        ("baseline", 0.02),
        ("fixed", 0.01),
        ("adaptive", 0.005),
        ("reference", 0.0),
    ):
        ((stamp, path),) = found[f"/{mode}/path"]
        assert (stamp, path.header.frame_id) == (STAMPS[0], "odom")
        xyz = [[p.pose.position.x, p.pose.position.y, p.pose.position.z] for p in path.poses]
        np.testing.assert_allclose(xyz, along_x(drift).T_world_sensor[:, :3, 3], atol=1e-8)
    for (stamp, sent), T in zip(found["/tf"], along_x(0.005).T_world_sensor, strict=True):
        (moved,) = sent.transforms
        assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "sensor")
        assert stamp == moved.header.stamp.sec * 10**9 + moved.header.stamp.nanosec
        assert moved.transform.translation.x == pytest.approx(T[0, 3])
    scans = {scan.stamp: scan for scan in study.sequences.open("three")}
    for (stamp, cloud), expected in zip(found["/points"], STAMPS[::10], strict=True):
        assert (stamp, cloud.header.frame_id) == (expected, "sensor")
        points = cloud.data.view("<f4").reshape(-1, 3)
        np.testing.assert_array_equal(points, scans[stamp].points)


def test_an_mcap_holds_what_was_chosen_and_how_it_went(study):
    record_replays(study, "three")
    found = messages(study.folder / "recordings/three")
    made, end = STAMPS[::10].tolist(), int(STAMPS[-1])
    assert numbers(found, "/adaptive/predicted_error") == (made, [0.7] * 4)
    assert numbers(found, "/adaptive/predicted_fixed_error") == (made, [0.9] * 4)
    assert numbers(found, "/adaptive/similarity") == (made, [0.25] * 4)
    # What is not known yet is left out.
    assert numbers(found, "/adaptive/estimated_error") == (made[1:], [2.0, 3.0, 4.0])
    assert numbers(found, "/adaptive/estimated_error_high") == (made[1:], [3.0] * 3)
    # A choice stays until the end.
    name = "/adaptive/parameters/max_correspondence_distance"
    assert numbers(found, name) == ([*made, end], [1.0, 2.0, 3.0, 4.0, 4.0])
    assert numbers(found, "/adaptive/weights/2") == ([*made, end], [0.75] * 5)
    assert numbers(found, "/adaptive/lost")[1] == [0.0, 0.0, 1.0, 0.0, 0.0]
    assert numbers(found, "/adaptive/parameters/kernel")[1] == ["none", "huber"] * 2
    assert numbers(found, "/fixed/parameters/kernel") == (made[:1], ["huber"])
    assert numbers(found, "/adaptive/selection_ms")[1] == [4.0, 8.0, 12.0, 16.0]
    assert numbers(found, "/adaptive/register_ms")[1] == pytest.approx(2.0 * np.arange(N))
    assert numbers(found, "/adaptive/late_ms")[1] == [20.0] * N
    assert "/fixed/late_ms" not in found
    assert np.flatnonzero(numbers(found, "/fixed/restarted")[1]).tolist() == [7]
    stamps, errors = numbers(found, "/baseline/true_error")
    assert stamps == STAMPS[: len(stamps)].tolist()
    # 11 steps are longer than 3 m; but for rounding, 10 are not.
    assert errors == pytest.approx([100.0 * 10.5 * 0.02 / 3.0] * len(errors), rel=0.06)


def test_topics_have_names_that_ros_allows():
    assert topic("adaptive", "parameters", "ndt.max-range") == "/adaptive/parameters/ndt_max_range"


def test_recordings_are_the_same_again_and_replays_stay(study):
    before = {p: p.read_bytes() for p in (study.folder / "replays").rglob("*") if p.is_file()}
    first = record_replays(study, "three").read_bytes()
    assert record_replays(study, "three").read_bytes() == first  # over the one that is there
    after = {p: p.read_bytes() for p in (study.folder / "replays").rglob("*") if p.is_file()}
    assert after == before


def test_the_command_says_what_it_wrote(study, study_file):
    done = succeeded("record", study_file, "--folder", study.folder)
    assert f"{study.folder / 'recordings/three/three.mcap'} (" in done.stdout
    succeeded("record", study_file, "three", "--folder", study.folder)


@contextmanager
def files_of_at_most(size):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [1_000, 100_000])
def test_a_full_disk_leaves_nothing_half_written(study, study_file, size):
    list(study.sequences.open("three"))  # which is in the cache then
    for earlier in (False, True):
        if earlier:
            succeeded("record", study_file, "--folder", study.folder)
        before = left(study)
        with files_of_at_most(size):
            done = call("record", study_file, "--folder", study.folder)
        assert done.exit_code == 2
        (line,) = done.stderr.strip().splitlines()
        assert line.startswith(f"error: {study.folder / 'recordings/three'}: cannot be written (")
        assert line.endswith("; make room, and run the same command again")
        assert left(study) == before
        assert not [p for p in (study.folder / "recordings").iterdir() if p.name.startswith(".")]


def test_ctrl_c_leaves_nothing_half_written(study):
    def interrupt(_what, done, _n):
        if done == 15:
            raise KeyboardInterrupt

    before = left(study)
    with pytest.raises(KeyboardInterrupt):
        record_replays(study, "three", interrupt)
    assert left(study) == before
    assert list((study.folder / "recordings").iterdir()) == []


def test_sequences_that_were_not_replayed_are_refused(study, study_file, tmp_path):
    for names, folder, said in (
        (["one"], study.folder, "one: there is no replay; .* `adaptune online`"),
        (["thre"], study.folder, "thre: there is no such sequence in the study: .*three"),
        ([], tmp_path / "other", "three: there is no replay; .* `adaptune online`"),
    ):
        assert re.search(said, refused("record", study_file, *names, "--folder", folder))


def test_a_reference_of_something_else_and_a_damaged_replay_are_refused(study, study_file):
    other = load_study(study_file, ["sequences.three.reference=none"], study.folder)
    with pytest.raises(StoredReplayError, match="was judged by another reference; run"):
        record_replays(other, "three")
    path = folder_of(study, "adaptive") / "selections.csv"
    path.write_text(path.read_text().replace("0.7000", "many"))
    with pytest.raises(StoredReplayError, match=r"selections\.csv: is damaged"):
        record_replays(study, "three")


def positions(path):
    ((_, message),) = path
    return np.array([(p.pose.position.x, p.pose.position.y) for p in message.poses])


def test_all_begin_where_they_first_overlap_the_reference(study):
    folder, truth = reference_folder(study, "three"), along_x()
    late = Trajectory(STAMPS[10:], truth.T_world_sensor[10:])
    write_reference(folder, late, truth)
    found = messages(record_replays(study, "three").parent)
    np.testing.assert_allclose(positions(found["/reference/path"])[0], 0.0, atol=1e-9)
    own = along_x(0.02).T_world_sensor
    placed = (invert(own[10]) @ own)[:, :2, 3]
    np.testing.assert_allclose(positions(found["/baseline/path"]), placed, atol=1e-8)
    (folder / "reference.tum").unlink()
    without = messages(record_replays(study, "three").parent)
    assert not {"/reference/path", "/baseline/true_error"} & set(without)
    np.testing.assert_allclose(positions(without["/fixed/path"])[0], 0.0, atol=1e-9)


def test_clouds_are_thinned_and_have_a_pose(study, monkeypatch):
    monkeypatch.setattr("online.recordings.MAX_POINTS", 100)
    # No pose, no cloud: the second second is beyond the path.
    short = Trajectory(STAMPS[:10], along_x().T_world_sensor[:10])
    monkeypatch.setattr("online.recordings._placed", lambda *_: short)
    seen = []
    found = messages(record_replays(study, "three", lambda *call: seen.append(call)).parent)
    assert [call[1] for call in seen] == [*range(1, N + 1), N]
    ((stamp, cloud),) = found["/points"]
    points = cloud.data.view("<f4").reshape(-1, 3)
    (scan,) = [s for s in study.sequences.open("three") if s.stamp == stamp]
    same = (scan.points[:, None] == points).all(axis=2)
    assert points.shape == (100, 3)
    assert (np.diff(same.argmax(axis=0)) > 0).all()
