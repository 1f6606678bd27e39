"""How a recording to learn from is found and named."""

import json
import shutil

import drives
import estimates
import numpy as np
import pytest
import small_bag

from adaptune.errors import AdaptuneError
from adaptune.study.new_drive import find_drive
from adaptune.study.references import ensure_references
from offline.config import load_study


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A drive that the study does not name; not to be changed."""
    return drives.write_bag(tmp_path_factory.mktemp("bags") / "new drive.bag", drives.scans(7, 12))


@pytest.fixture
def find(study_file, tmp_path):
    def make(drive, *overrides, reference=None, trained=("one", "two")):
        study = load_study(study_file, overrides, tmp_path / "run")
        return find_drive(study, str(drive), reference, trained)

    return make


def entry_of(found):
    (entry,) = found.sequences.values()
    return entry


def test_a_bag_is_named_by_its_file_and_described_as_the_others_are(find, bag):
    own = ["sequences.one.stride=2", "sequences.one.start=1", "sequences.one.max_gap=0.5"]
    found = find(bag, *own)
    assert (found.name, found.entry) == ("new_drive", "new_drive")
    assert entry_of(found) == {
        "bag": str(bag),
        "points": "/points",
        "stride": 2,
        "reference": "/truth",
        "max_gap": 0.5,
    }
    assert found.words == (
        "new_drive becomes a training sequence: points /points, reference /truth."
    )


def test_a_second_drive_of_a_name_gets_a_suffix(find, bag, tmp_path):
    for name in ("one.bag", "one_2.bag"):
        shutil.copyfile(bag, tmp_path / name)
    assert find(tmp_path / "one.bag").name == "one_2"
    taken = "sequences.one_2={bag: three.bag, points: /points}"
    assert find(tmp_path / "one.bag", taken, "test=[]").name == "one_3"


def test_trials_of_another_recording_keep_their_name(find, bag, tmp_path):
    note = tmp_path / "run/trials/new_drive/inputs.json"
    note.parent.mkdir(parents=True)
    about = {"odometry": {"content": {}}, "sequence": {}, "descriptors": {}}
    note.write_text(json.dumps(about | {"recording": ["another"]}))
    assert find(bag).name == "new_drive_2"


def test_a_sequence_of_the_study(find):
    found = find("three")
    assert (found.entry, found.sequences, found.was_test) == ("three", {}, True)
    assert not find("three", "test=[]").was_test
    parts = ["training=[one: 0-60%]", "test=[one: 60-100%]"]
    assert find("one_60-100", *parts).entry == {"one": "60-100%"}


def test_a_copy_of_a_sequence_is_that_sequence(find, study_file, tmp_path):
    shutil.copyfile(study_file.parent / "three.bag", tmp_path / "copy.bag")
    assert find(tmp_path / "copy.bag") == find("three")
    shutil.copyfile(study_file.parent / "two.bag", tmp_path / "other.bag")
    with pytest.raises(AdaptuneError, match=r"^two is a training sequence of the study already: "):
        find(tmp_path / "other.bag")


def test_what_was_begun_goes_on(find, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/learned.yaml").write_text("training: [three]")
    assert find("three").begun
    with pytest.raises(AdaptuneError, match="there is nothing to learn from it"):
        find("three", trained=("one", "two", "three"))


def test_of_a_bag_with_other_topics_what_is_found_counts(find, tmp_path):
    begin = small_bag.START
    messages = [
        (topic, stamp, make)
        for i in range(4)
        for stamp in [begin + i * 10**8]
        for topic, make in (
            ("/lidar", small_bag.cloud(stamp)),
            ("/poses", small_bag.pose(stamp, i)),
        )
    ]
    bag = small_bag.write(tmp_path / "other.bag", messages)
    found = entry_of(find(bag, "sequences.one.stride=2"))
    assert found == {"bag": str(bag), "points": "/lidar", "reference": "/poses"}


def test_a_reference_of_its_own(find, bag, tmp_path):
    file = tmp_path / "poses.tum"
    file.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    shifted = "sequences.one.clock_offset=1"
    given = entry_of(find(bag, shifted, reference=str(file)))
    assert given["reference"] == str(file)
    assert "clock_offset" not in given
    assert entry_of(find(bag, shifted, reference="/truth"))["clock_offset"] == 1.0
    assert entry_of(find(bag, reference="estimated"))["reference"] == "estimated"
    # Files of the other sequences are not its reference; what was found in the bag is.
    files = [f"sequences.{name}.reference={file}" for name in ("one", "two", "three")]
    offset = [f"sequences.{name}.clock_offset=1700000000" for name in ("one", "two", "three")]
    found = entry_of(find(bag, *files, *offset))
    assert found == {"bag": str(bag), "points": "/points", "reference": "/truth"}


@pytest.mark.parametrize("reference", ["estimated", ""])
def test_an_estimate_of_another_drive_is_not_its_reference(
    find, bag, study_file, tmp_path, monkeypatch, reference
):
    estimates.install(monkeypatch)
    prior = ["sequences.one.position_prior=/truth", "sequences.one.max_gap=5"]
    overrides = [f"sequences.one.reference={reference}", *prior]
    ensure_references(load_study(study_file, overrides, tmp_path / "run"), ["one"])
    found = entry_of(find(bag, *overrides))
    wanted = {"reference": "estimated"} if reference else {}
    assert found == {
        "bag": str(bag),
        "points": "/points",
        "position_prior": "/truth",
        "max_gap": 5.0,
        **wanted,
    }
    assert entry_of(find(bag, *overrides, reference="estimated"))["max_gap"] == 5.0
    given = entry_of(find(bag, *overrides, reference="/truth"))
    assert given == {"bag": str(bag), "points": "/points", "reference": "/truth"}


def test_positions_of_another_drive_are_not_joined(find, bag, tmp_path):
    file = tmp_path / "gps.tum"
    file.write_text("1700000000 0 0 0 0 0 0 1\n1700000009 1 0 0 0 0 0 1\n")
    prior = [f"sequences.one.position_prior={file}", "sequences.one.max_gap=5"]
    found = entry_of(find(bag, "sequences.one.reference=estimated", *prior))
    assert found == {"bag": str(bag), "points": "/points", "reference": "estimated"}


def test_a_folder_of_scans(find, tmp_path):
    folder = tmp_path / "scans"
    folder.mkdir()
    for i in range(3):
        np.full((30, 4), i + 1.0, np.float32).tofile(folder / f"{i}.bin")
    (folder / "times.txt").write_text("0\n1\n2\n")
    found = find(folder)
    assert (found.name, entry_of(found)) == ("scans", {"folder": str(folder)})


@pytest.mark.parametrize(
    ("drive", "reference", "said"),
    [
        ("thre", None, "thre: is neither a file or folder nor a sequence .*: did you mean 'three'"),
        ("three", "/truth", "--reference: the study names three already"),
        (
            "BAG",
            "/truht",
            "--reference: the recording has no topic '/truht': did you mean '/truth'",
        ),
    ],
)
def test_what_cannot_be_found(find, bag, drive, reference, said):
    with pytest.raises(AdaptuneError, match=said):
        find(str(bag) if drive == "BAG" else drive, reference=reference)


def test_poses_are_no_drive(find, tmp_path):
    (tmp_path / "poses.tum").write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    with pytest.raises(AdaptuneError, match="holds poses and no scans"):
        find(tmp_path / "poses.tum")
