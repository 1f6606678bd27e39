import os
import shutil

import drives
import estimates
import numpy as np
import pytest

from adaptune.recording import cache
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import RecordedSequence, open_sequence, wants_estimate
from adaptune.reference.estimated import EstimateError
from adaptune.study import references
from adaptune.study.references import ensure_references, estimates_of
from adaptune.trajectory import read_trajectory
from offline.config import load_study

LEFT_OUT = "sequences.one.reference="
EXTRINSIC = "sequences.one.extrinsic=[0, 2, 0, 0, 0, 0, 1]"


def data(study, names):
    length, found = study.config.sub_trajectory, estimates_of(study.sequences, names)
    return {name: (stored.error(length), stored.unknown_share) for name, stored in found.items()}


def ensure(study, names, *given, **more):
    length = study.config.sub_trajectory
    return ensure_references(study.sequences, names, length, *given, **more)


@pytest.fixture
def estimator(monkeypatch):
    return estimates.install(monkeypatch)


@pytest.fixture
def load(study_file, tmp_path, caplog):
    caplog.set_level("INFO")
    return lambda *overrides: load_study(study_file, overrides, tmp_path / "run")


def test_only_what_has_no_reference_is_estimated_and_once(estimator, load, caplog):
    study = load(LEFT_OUT, "sequences.three.reference=none")
    shown = []
    names = ["one", "two", "three"]
    ensure(study, names, lambda *given: shown.append(given))
    assert estimator.names == ["one.bag"]
    assert shown == [("one, estimating its reference", 40, 40)]
    (said,) = caplog.messages
    assert said.startswith(
        "one: its reference is estimated, 12 m; its own error is 0.31 % over 3 m, unknown for 0 % "
    )
    made = {path.name for path in (study.folder / "references").iterdir()}
    assert {"one.json", "one.tum"} <= made <= {"one.json", "one.tum", "one.png"}
    ensure(study, names)
    assert len(estimator.asked) == 1
    estimated = [study.sequences.estimate(name) is not None for name in names]
    assert estimated == [True, False, False]
    reference = study.sequences.open("one").reference()
    np.testing.assert_allclose(reference.T_world_sensor[:, 0, 3], 0.3003 * np.arange(40), atol=1e-8)
    assert study.sequences.open("three").reference() is None
    # It is a file like another.
    assert study.sequences.reference("one")["sequences"]["one"]["reference"] == "a file"
    assert len(study.sequences.files("one").reference) == 1


@pytest.mark.usefixtures("estimator")
def test_it_is_asked_for_where_there_are_poses(load):
    # What is said of the recorded poses is not of the estimated ones.
    study = load("sequences.one.reference=estimated", EXTRINSIC, "sequences.one.max_gap=9")
    assert study.sequences.open("one").reference() is None
    ensure(study, ["one"])
    found = study.sequences.open("one").reference()
    np.testing.assert_allclose(found.T_world_sensor[0], np.eye(4), atol=1e-9)
    assert found.max_gap == 1.0
    given = load()
    assert given.sequences.open("one").reference().T_world_sensor[-1, 0, 3] == pytest.approx(11.7)
    assert given.sequences.estimate("one") is None


def test_where_it_is_not_trusted_there_is_a_gap(estimator, load, caplog):
    estimator.untrusted = [20]
    study = load(LEFT_OUT)
    ensure(study, ["one"])
    reference = study.sequences.open("one").reference()
    assert len(reference) == 30
    at = reference.at(np.array([drives.FIRST_STAMP + 25 * 10**8]))
    assert np.isnan(at).all()
    assert "unknown for 25 % of the scans" in caplog.text
    found = data(study, ["one", "two"])
    assert found == {"one": (pytest.approx(0.3116, abs=1e-4), pytest.approx(0.25, abs=0.01))}


@pytest.mark.usefixtures("estimator")
def test_a_file_that_was_estimated_is_called_so(load, tmp_path):
    study = load(LEFT_OUT)
    ensure(study, ["one"])
    known, file = data(study, ["one"]), tmp_path / "my_reference.tum"
    for suffix in (".tum", ".json"):
        made = study.folder / f"references/one{suffix}"
        made.rename(file.with_suffix(suffix))
    named = load(f"sequences.one.reference={file}")
    assert named.sequences.estimate("one")
    assert data(named, ["one", "two"]) == known
    assert named.sequences.config("one").reference == str(file)
    # Other files beside it say nothing.
    for text in ("[1, 2]", "{}", "no JSON"):
        file.with_suffix(".json").write_text(text)
        assert named.sequences.estimate("one") is None


def test_it_is_estimated_again_when_something_has_changed(estimator, load, monkeypatch, caplog):
    ensure(load(LEFT_OUT), ["one"])
    shorter = LEFT_OUT, "sequences.one.stop=3"
    for overrides, change in ((shorter, "stop is new"), ([LEFT_OUT], "stop is gone")):
        caplog.clear()
        ensure(load(*overrides), ["one"])
        words = f"one: its reference is estimated again: sequences.one.{change}"
        assert caplog.messages[0].startswith(words)
        ensure(load(*overrides), ["one"])
    assert len(estimator.asked) == 2  # the first one was kept
    monkeypatch.setattr("adaptune.reference.estimate.VERSION", 0)
    ensure(load(LEFT_OUT), ["one"])
    assert len(estimator.asked) == 3
    assert "again: estimator changed from 1 to 0" in caplog.text


def test_another_study_of_the_same_recording_takes_what_is_kept(
    estimator, study_file, tmp_path, monkeypatch, caplog
):
    caplog.set_level("INFO")
    copy = shutil.copy(study_file.parent / "one.bag", tmp_path / "copy.bag")
    paths = []

    def estimated(*overrides):
        number = len(paths)
        study = load_study(study_file, [LEFT_OUT, *overrides], tmp_path / str(number))
        ensure(study, ["one"])
        paths.append(study.sequences.estimate_path("one"))
        return len(estimator.asked)

    assert estimated() == 1
    # The same content under another path, with what is said of the reference alone.
    (kept,) = (cache.folder() / references.ESTIMATES).iterdir()
    os.utime(kept, (1.0, 1.0))
    assert estimated(f"sequences.one.bag={copy}", "sequences.one.max_gap=9") == 1
    assert kept.stat().st_mtime > 1.0
    assert f"one: its reference was estimated before ({kept})" in caplog.messages
    for suffix in (".tum", ".json"):
        one, two = (path.with_suffix(suffix).read_text() for path in paths)
        assert one == two
    assert estimated("sequences.one.stride=2") == 2
    assert estimated(f"sequences.one.bag={study_file.parent / 'two.bag'}") == 3
    for damaged in (b"", kept.read_bytes()[:-200], b"x" * 500):
        kept.write_bytes(damaged)
        asked = len(estimator.asked)
        assert estimated() == asked + 1
        assert estimated() == asked + 1
    # Nothing is left of the writing, and nothing is kept where the cache is off.
    assert len(list(kept.parent.iterdir())) == 3
    kept.unlink()
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "0")
    asked = len(estimator.asked)
    assert [estimated(), estimated()] == [asked + 1, asked + 2]
    # They count against what the cache may take.
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", "1e-6")
    estimated()
    assert not list(kept.parent.iterdir())


def test_a_recording_with_poses_of_its_own_keeps_them(tmp_path):
    kitti = tmp_path / "kitti"
    (kitti / "velodyne").mkdir(parents=True)
    for i in range(3):
        np.full((30, 4), i + 1.0, "<f4").tofile(kitti / f"velodyne/{i:06}.bin")
    (kitti / "times.txt").write_text("0\n0.1\n0.2\n")
    (kitti / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    plain = SequenceConfig(kitti=str(kitti))
    assert wants_estimate(plain)
    (kitti / "poses.txt").write_text("".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(3)))
    assert not wants_estimate(plain)
    assert open_sequence(plain).reference() is not None
    for word, wanted in (("none", False), ("estimated", True)):
        config = SequenceConfig(kitti=str(kitti), reference=word)
        assert wants_estimate(config) == wanted
        assert open_sequence(config).reference() is None


def test_a_recording_that_allows_none_is_named_and_not_tried_again(estimator, load, caplog):
    study = load(LEFT_OUT)
    ensure(study, ["one"])
    estimator.refusal = EstimateError("the robot hardly moves")
    other = load(LEFT_OUT, "sequences.one.stop=3")
    with pytest.raises(EstimateError, match=r"^sequences\.one: .*one\.bag: the robot hardly moves"):
        ensure(other, ["one"])
    # What was estimated of something else is gone.
    assert study.sequences.estimate("one") is None
    # It is not tried again, and said again.
    n = len(estimator.asked)
    with pytest.raises(EstimateError, match=r"^sequences\.one: .*one\.bag: the robot hardly moves"):
        ensure(other, ["one"])
    refused = ensure(other, ["one", "two"], required=False)
    assert list(refused) == ["one"]
    assert refused["one"].endswith("one.bag: the robot hardly moves")
    assert len(estimator.asked) == n
    assert other.sequences.open("one").reference() is None
    assert other.sequences.estimate("one") is None
    # But when something has changed.
    estimator.refusal = None
    caplog.clear()
    assert not ensure(study, ["one"], required=False)
    assert caplog.messages[0] == "one: its reference is estimated again: sequences.one.stop is gone"
    assert study.sequences.estimate("one") is not None


def test_parts_of_a_recording_take_theirs_from_the_whole(estimator, load, monkeypatch):
    halves = load(LEFT_OUT, "training=[one: 0-50%]", "test=[one: 50-100%]")
    monkeypatch.setattr("adaptune.reference.estimate.SHORTEST", 3.0)
    for name in ("one_0-50", "one_50-100"):
        ensure(halves, [name])
        made = read_trajectory(halves.sequences.estimate_path(name))
        assert made.stamps.tolist() == [scan.stamp for scan in halves.sequences.open(name)]
        np.testing.assert_allclose(made.T_world_sensor[0], np.eye(4), atol=1e-6)
        assert halves.sequences.estimate(name).error(3.0) == pytest.approx(0.31, abs=0.01)
    assert len(estimator.asked) == 1
    # Each by itself before, it is estimated anew.
    alone = load(LEFT_OUT, "training=[one: 0-50%]", "test=[three]")
    ensure(alone, ["one_0-50"])
    assert len(estimator.asked) == 2


def test_parts_of_two_recordings_take_one_pass_of_each(estimator, load, monkeypatch):
    monkeypatch.setattr("adaptune.reference.estimate.SHORTEST", 3.0)
    roles = ("training=[one: 0-50%, two: 0-50%]", "test=[one: 50-100%, two: 50-100%]")
    study = load(LEFT_OUT, "sequences.two.reference=", *roles)
    ensure(study, study.training)
    ensure(study, study.config.test)
    assert estimator.names == ["one.bag", "two.bag"]


@pytest.mark.parametrize("stamp", ["start", "end"])
def test_parts_are_cut_by_the_stamps_of_their_scans(load, stamp):
    study = load("training=[one: 0-50%]", "test=[one: 50-100%]", f"sequences.one.stamp={stamp}")
    config = study.sequences.unseen("one_50-100")
    whole = np.array(
        [scan.stamp for scan in open_sequence(config.model_copy(update={"part": None}))]
    )
    part = RecordedSequence(config)
    assert whole[part.holds(whole)].tolist() == [scan.stamp for scan in part]


def test_a_part_that_is_little_or_does_not_serve_is_estimated_by_itself(estimator, load):
    few = load(LEFT_OUT, "training=[one: 0-30%]", "test=[three]")
    ensure(few, ["one_0-30"])
    assert len(estimator.asked) == 1
    short = load(LEFT_OUT, "training=[one: 0-50%]", "test=[one: 50-100%]")
    ensure(short, ["one_50-100"])
    assert len(estimator.asked) == 3


def test_an_interruption_leaves_those_that_are_done(estimator, load, monkeypatch):
    study = load(LEFT_OUT, "sequences.two.reference=")

    def interrupted(scans, *given):
        if "two" in scans.name:
            raise KeyboardInterrupt
        return estimator(scans, *given)

    monkeypatch.setattr("adaptune.reference.estimate.estimate_reference", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ensure(study, study.training)
    assert study.sequences.estimate("one") is not None
    assert study.sequences.estimate("two") is None


@pytest.mark.usefixtures("estimator")
def test_a_damaged_note_is_told(load):
    study = load(LEFT_OUT)
    ensure(study, ["one"])
    (study.folder / "references/one.json").write_text("{")
    with pytest.raises(EstimateError, match=r"one\.json: is damaged .* remove it and one\.tum"):
        ensure(study, ["one"])
