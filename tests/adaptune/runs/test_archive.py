import dataclasses
import json
import math

import numpy as np
import pytest
from random_models import assert_same

from adaptune.runs.archive import Archive, ArchiveError, Frames, Trial

N = 40
PARAMETERS = {"distance": 0.1 + 0.2, "points": 7, "kernel": "Huber", "deskew": True}


def random_trial(seed=0, parameters=PARAMETERS):
    rng = np.random.default_rng(seed)
    errors = rng.gamma(1.0, size=N).astype(np.float32).astype(float)
    errors[3], errors[-5:] = np.inf, np.nan
    return Trial.of(
        dict(parameters),
        rng.normal(size=(N, 4, 4)),
        errors,
        rng.random(N) < 0.1,
        rng.random(),
        others={"rpe": rng.random(), "cpu": rng.random()},
        repeats=[{"rte": rng.random()}, {"rte": rng.random()}],
    )


def random_frames(seed=0):
    rng = np.random.default_rng(seed)
    T_ref_sensor = rng.normal(size=(N, 4, 4))
    T_ref_sensor[2] = np.nan
    stamps = 1_700_000_000_123_456_789 + np.arange(N) * 100_000_001
    counts = rng.integers(0, 1000, (N, 90)).astype(np.float32)
    elevations = rng.normal(-15.0, 1.0, N).astype(np.float32)
    return Frames(stamps, T_ref_sensor, counts, {"ndt": 90}, elevations)


def test_trials_survive(tmp_path):
    archive, (trial, whole, bare) = Archive(tmp_path / "trials"), map(random_trial, (1, 2, 3))
    archive.write("cave", 12, trial)
    archive.write("cave", 12, whole, kind="whole")
    archive.write("cave", 12, bare, kind="bare")
    again = Archive(tmp_path / "trials")
    assert_same(again.read("cave", 12), trial)
    assert_same(again.read("cave", 12, kind="whole"), whole)
    assert_same(again.read("cave", 12, "bare"), bare)
    assert again.trial_path("cave", 12).is_file()
    assert again.trial_path("cave", 12) != again.trial_path("cave", 12, kind="whole")
    assert len(list((tmp_path / "trials" / "cave").iterdir())) == 3
    assert list(again.finished("cave")) == [12]


def test_a_trial_of_an_older_adaptune_counts(tmp_path):
    archive, trial = Archive(tmp_path), random_trial()
    archive.write("cave", 0, trial)
    arrays = dict(np.load(path := archive.trial_path("cave", 0)))
    more = json.loads(arrays["summary"].tobytes()) | {"unhealthy": {"max_speed": 3}}
    arrays |= {"summary": np.frombuffer(json.dumps(more).encode(), np.uint8)}
    np.savez(path, **arrays, registered=np.ones(N, bool), seconds=np.zeros(N, np.float32))
    assert_same(Archive(tmp_path).read("cave", 0), trial)
    assert Archive(tmp_path).finished("cave") == {0: trial.summary}


def test_frames_count_with_their_descriptors_only(tmp_path):
    archive = Archive(tmp_path)
    shares = np.random.default_rng(0).random((N, 92), np.float32)
    frames = dataclasses.replace(random_frames(), descriptors=shares, blocks={"ndt": 90, "b": 2})
    assert not archive.has_frames("street", ["ndt", "b"])
    archive.write_frames("street", frames)
    assert_same(archive.read_frames("street"), frames)
    assert archive.has_frames("street", ["ndt", "b"])
    assert not archive.has_frames("street", ["b", "ndt"])
    assert not archive.has_frames("street", ["ndt"])


def fill(folder, n=4):
    archive = Archive(folder)
    for number in range(n):
        archive.write("cave", number, random_trial(number))
    archive.write("cave", 1, random_trial(9), kind="whole")
    archive.write("street", 0, random_trial(7))
    return archive


def test_finished_trials_are_told_without_their_arrays(tmp_path, monkeypatch):
    archive = fill(tmp_path)
    written = archive.finished("cave")
    assert written == {n: random_trial(n).summary for n in range(4)}
    archive.trial_path("cave", 2).unlink()
    monkeypatch.setattr("adaptune.runs.archive._trial_of", None)
    again = Archive(tmp_path)
    assert again.finished("cave") == {n: written[n] for n in (0, 1, 3)}
    assert again.finished("street") == {0: random_trial(7).summary}
    assert again.finished("none") == {}


def test_mean_error_counts_a_lost_track_as_30_and_the_unknown_not_at_all():
    errors = np.array([1.0, 2.0, np.inf, 50.0, np.nan, np.nan])
    trial = Trial.of({}, np.zeros((6, 4, 4)), errors, np.zeros(6), 0.0)
    assert trial.mean_error == pytest.approx((1.0 + 2.0 + 30.0 + 30.0) / 4)
    assert not math.isnan(random_trial().mean_error)


def test_tidy_removes_only_what_is_unfinished(tmp_path):
    archive = Archive(tmp_path)
    archive.write("cave", 0, random_trial())
    archive.write_frames("cave", random_frames())
    unfinished = tmp_path / "cave" / ".00001.abc.npz"
    unfinished.write_bytes(b"PK")
    archive.tidy()
    assert not unfinished.exists()
    assert_same(archive.read("cave", 0), random_trial())
    assert_same(archive.read_frames("cave"), random_frames())
    Archive(tmp_path / "none").tidy()


def truncate(path):
    path.write_bytes(path.read_bytes()[:-200])


def objects(path):
    arrays = dict(np.load(path))
    name = "errors" if "errors" in arrays else "stamps"
    np.savez(path, **arrays | {name: np.array([None, {}], object)})


def lack(path):
    arrays = dict(np.load(path))
    np.savez(path, **{name: arrays[name] for name in ("T_odom_sensor", "stamps") if name in arrays})


@pytest.mark.parametrize("harm", [truncate, objects, lack])
def test_a_damaged_file_is_named(tmp_path, harm):
    archive = Archive(tmp_path)
    archive.write("cave", 0, random_trial())
    archive.write_frames("cave", random_frames())
    harm(archive.trial_path("cave", 0))
    harm(tmp_path / "cave" / "frames.npz")
    with pytest.raises(ArchiveError, match=r"cave/00000\.npz") as caught:
        archive.read("cave", 0)
    assert "pickle" not in str(caught.value)  # nobody is to load it unsafely
    with pytest.raises(ArchiveError, match=r"cave/frames\.npz"):
        archive.read_frames("cave")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ArchiveError, match=r"cave/00007\.npz: there is no such file"):
        Archive(tmp_path).read("cave", 7)
    with pytest.raises(ArchiveError, match=r"cave/frames\.npz: there is no such file"):
        Archive(tmp_path).read_frames("cave")
