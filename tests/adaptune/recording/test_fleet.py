"""Folders: the parts of one recording, or several recordings."""

import commands
import drives
import pytest

from adaptune.recording.config import bag_paths
from adaptune.recording.fleet import check_alike, read_folder, recordings_at
from adaptune.recording.inspect import inspect
from adaptune.recording.scan import SequenceError


def write(folder, **starts):
    """Bags of 1 s by name, each with the seconds at which it begins."""
    for name, start in starts.items():
        late = [(stamp + round(start * 1e9), xyz, T) for stamp, xyz, T in drives.scans(0, 10)]
        drives.write_bag(folder / f"{name}.bag", late)
    return folder


@pytest.mark.parametrize(
    ("starts", "reading"),
    [
        ({"drive_0": 0.0, "drive_1": 1.0, "drive_2": 2.0}, "one"),
        ({"drive_0": 0.0, "drive_1": 500.0}, "several"),
        ({"street": 0.0, "park": 0.0}, "several"),
        ({"street": 0.0, "park": 1.0}, None),
        ({"drive_0": 0.0, "drive_1": 20.0}, None),
        ({"drive_0": 0.0}, "one"),
    ],
)
def test_times_and_names_tell(tmp_path, starts, reading):
    assert read_folder(write(tmp_path, **starts)).reading == reading


def test_no_time_between_those_that_overlap_is_told(tmp_path):
    assert read_folder(write(tmp_path, street=0.0, park=0.0)).why == "some overlap"


def test_where_it_is_not_clear_an_option_chooses(tmp_path):
    write(tmp_path, park=0.0, street=1.0)
    with pytest.raises(SequenceError, match=r"in 2 parts, or 2 recordings: .* `--as one` or"):
        recordings_at([tmp_path])
    assert recordings_at([tmp_path], "one") == [tmp_path]
    bags = [tmp_path / "park.bag", tmp_path / "street.bag"]
    assert recordings_at([tmp_path], "several") == bags
    assert recordings_at(bags) == bags


def test_the_only_bag_of_a_folder_has_its_own_name(tmp_path):
    assert recordings_at([write(tmp_path, drive_0=0.0)]) == [tmp_path / "drive_0.bag"]


def test_a_folder_of_folders_holds_several(tmp_path):
    for name in ("monday", "tuesday"):
        write(tmp_path / name, drive_0=0.0, drive_1=1.0)
    assert recordings_at([tmp_path]) == [tmp_path / "monday", tmp_path / "tuesday"]


def test_folders_of_days_hold_their_recordings_and_their_parts(tmp_path):
    write(tmp_path / "2024/monday", run_1=0.0, run_2=500.0)
    write(tmp_path / "2024/tuesday", run_0=0.0, run_1=1.0)
    runs = [tmp_path / "2024/monday/run_1.bag", tmp_path / "2024/monday/run_2.bag"]
    assert recordings_at([tmp_path]) == [*runs, tmp_path / "2024/tuesday"]
    said = commands.succeeded("inspect", tmp_path).output
    assert "2024/monday/run_1.bag" in said
    assert "lacks" not in said.partition("run_1.bag")[2]


def test_files_of_an_operating_system_are_no_recordings(tmp_path):
    write(tmp_path, drive=0.0)
    for name in ("._drive.bag", ".DS_Store", "Thumbs.db", "__MACOSX/._drive.bag"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"\0\5\x16\7")
    (tmp_path / "@eaDir/drive.bag").mkdir(parents=True)
    assert recordings_at([tmp_path]) == [tmp_path / "drive.bag"]
    for given in (tmp_path, tmp_path / "*.bag"):
        assert bag_paths([str(given)]) == [tmp_path / "drive.bag"]


def test_a_bag_that_is_being_recorded_is_told(tmp_path):
    write(tmp_path, drive_0=0.0)
    (tmp_path / "drive_1.bag.active").touch()
    with pytest.raises(SequenceError, match=r"drive_1.bag.active: is still being recorded"):
        read_folder(tmp_path)


def test_recordings_of_different_rates_are_refused_together(tmp_path):
    write(tmp_path, fast=0.0)
    slow = [(3 * stamp - 2 * drives.FIRST_STAMP, *rest) for stamp, *rest in drives.scans(0, 10)]
    drives.write_bag(tmp_path / "slow.bag", slow)
    found = [inspect(tmp_path / f"{name}.bag") for name in ("fast", "slow")]
    check_alike(found[:1])
    with pytest.raises(SequenceError, match=r"fast.bag \(10.0 Hz, .*; slow.bag \(3.3 Hz"):
        check_alike(found)
