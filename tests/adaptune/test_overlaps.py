import shutil

import drives
import numpy as np
import pytest
import rec

from adaptune._system.strict import ConfigurationError
from adaptune.recording import SequenceConfig
from adaptune.recording.export import export
from adaptune.recording.recording import open_sequence
from adaptune.trajectory import write_tum
from offline.config import load_study


@pytest.fixture
def load(study_file, tmp_path):
    """Load a study whose test sequence is a copy of a training sequence's bag."""
    shutil.copytree(study_file.parent, tmp_path, dirs_exist_ok=True)
    shutil.copyfile(tmp_path / "one.bag", tmp_path / "copy.bag")

    def make(*overrides):
        given = ["sequences.three.bag=copy.bag", *overrides]
        return load_study(tmp_path / "small.yaml", given, tmp_path / "run")

    return make


def test_a_copy_of_a_training_sequence_is_refused(load):
    with pytest.raises(ConfigurationError, match=r"line 12: test\.0: 'three' is the recording of"):
        load()


@pytest.mark.parametrize(
    ("one", "three", "overlapping"),
    [
        ("stop=2", "start=2", False),
        ("stop=2", "start=1.9", True),
        ("start=1", "stride=2", True),
    ],
)
def test_sections_may_not_overlap(load, one, three, overlapping):
    overrides = [f"sequences.one.{one}", f"sequences.three.{three}"]
    if not overlapping:
        load(*overrides)
        return
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*overrides)


def test_a_copy_among_the_training_sequences_is_told(load, caplog):
    load("training=[one, three]", "test=[]")
    assert "training: 'one' and 'three' hold the same scans, which count twice" in caplog.text


def test_a_copy_is_left_out_with_what_it_is_a_copy_of(load, tmp_path):
    study = load("training=[one, three]", "test=[]")
    named = {name: study.sequences.recorded_in(name) for name in ("one", "two", "three")}
    assert named == dict.fromkeys(("one", "three"), str(tmp_path / "one.bag")) | {
        "two": str(tmp_path / "two.bag")
    }


def write_folder(folder, scans):
    folder.mkdir(exist_ok=True)
    for i, points in enumerate(scans):
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(folder / f"{i}.bin")
    (folder / "times.txt").write_text("".join(f"{i}\n" for i in range(len(scans))))


def written_again(folder, how):
    """The bag of `three` as other programs write it."""
    made = drives.scans(2, 40)
    if how == "ROS 2":
        recorded = open_sequence(SequenceConfig(bag=str(folder / "three.bag")))
        export(recorded, None, folder / "again", "ros2")
        return folder / "again"
    if how == "recorded later, compressed":
        clouds = [("/lidar", s + 10**12, drives.cloud(s, points)) for s, points, _ in made]
        return rec.write_bag(folder / "again.bag", clouds, "LZ4")
    if how == "points in another order, a third lost":
        rng = np.random.default_rng(0)
        made = [(s, rng.permutation(points)[: 2 * len(points) // 3], T) for s, points, T in made]
    elif how == "a part":
        made = made[22:31]
    elif how == "every third scan":
        made = made[1::3]
    elif how == "microseconds":
        made = [(s // 1000 * 1000, points, T) for s, points, T in made]
    elif how == "a folder":
        write_folder(folder / "again", [points for _, points, _ in made])
        times = (f"{stamp // 10**9}.{stamp % 10**9:09d}\n" for stamp, *_ in made)
        (folder / "again/times.txt").write_text("".join(times))
        return folder / "again"
    elif how == "another sensor of the same drive":
        made = [(s, points + np.float32(0.3), T) for s, points, T in made]
    elif how == "another drive at the same time":
        made = drives.scans(7, 40)
    return drives.write_bag(folder / "again.bag", made)


def test_a_copy_of_a_folder_is_refused(load, tmp_path):
    scans = [points for _, points, _ in drives.scans(5, 6)]
    for name in ("a", "b"):
        write_folder(tmp_path / name, scans[:3])
    poses = (tmp_path / "poses.tum").absolute()
    poses.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    given = [
        f"sequences.{name}={{folder: {folder}, reference: {poses}}}"
        for name, folder in (("one", "a"), ("three", "b"))
    ]
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*given)
    # Stamps that count from zero are the same by chance.
    write_folder(tmp_path / "b", scans[3:])
    load(*given)


@pytest.mark.parametrize(
    ("how", "same"),
    [
        ("ROS 2", True),
        ("recorded later, compressed", True),
        ("points in another order, a third lost", True),
        ("a part", True),
        ("every third scan", True),
        ("microseconds", True),
        ("a folder", True),
        ("another sensor of the same drive", False),
        ("another drive at the same time", False),
    ],
)
def test_the_same_scans_written_again_are_refused(load, tmp_path, how, same):
    path = written_again(tmp_path, how)
    poses = tmp_path / "poses.tum"
    write_tum(poses, load("sequences.three.bag=three.bag").sequences.open("three").reference())
    key = "folder" if (path / "times.txt").exists() else "bag"
    given = [f"sequences.four={{{key}: {path}, reference: {poses}}}", "training=[three]"]
    both = [*given, "sequences.three.bag=three.bag"]
    if not same:
        load(*both, "test=[four]")
        return
    for roles in (["test=[four]"], ["training=[one, four]", "test=[three]"]):
        with pytest.raises(ConfigurationError, match="proves nothing here"):
            load(*both, *roles)
    apart = ["sequences.three.stop=0.4", "sequences.four.start=3.5"]
    if how == "ROS 2":
        load(*both, *apart, "test=[four]")


def test_two_names_of_one_course(load):
    course = "{scenes: [cave], seed: 1}"
    names = ["courses.a=" + course, "courses.b=" + course, "training=[one, a]", "test=[b]"]
    with pytest.raises(ConfigurationError, match="'b' is the recording of the training"):
        load(*names)
    load(*names, "courses.b.seed=2")


def test_sections_of_several_bags_are_compared_by_their_stamps(load, tmp_path):
    earlier = [(stamp - 10 * 10**9, *rest) for stamp, *rest in drives.scans(9, 40)]
    drives.write_bag(tmp_path / "earlier.bag", earlier)
    both = ["sequences.one.bag=[earlier.bag, one.bag]", "sequences.one.start=11"]
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*both, "sequences.three.stop=2")
    load(*both, "sequences.three.stop=1")
