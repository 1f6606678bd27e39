import shutil

import drives
import pytest

from adaptune.strict import ConfigurationError
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


def test_a_copy_of_a_folder_is_refused(load, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for i in range(3):
            (tmp_path / name / f"{i}.bin").write_bytes(bytes([i + 1]) * 16 * (i + 1))
        (tmp_path / name / "times.txt").write_text("0\n1\n2\n")
    poses = (tmp_path / "poses.tum").absolute()
    poses.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    given = [
        f"sequences.{name}={{folder: {folder}, reference: {poses}}}"
        for name, folder in (("one", "a"), ("three", "b"))
    ]
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*given)
    for i in range(3):
        (tmp_path / "b" / f"{i}.bin").write_bytes(bytes([i + 7]) * 16 * (i + 1))
    load(*given)


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
