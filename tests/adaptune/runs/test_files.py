import csv
from pathlib import Path

import numpy as np
import pytest

from adaptune.odometry.tracker import RegisteredScan
from adaptune.runs.files import DriveLog, StoredReplayError, read_run, write_run
from adaptune.runs.record import Choice, Run
from adaptune.space import Selection
from adaptune.trajectory import read_tum

STAMP = 1_700_000_000_123_456_789


def step(i):
    T = np.eye(4)
    T[0, 3] = 0.5 * i
    return RegisteredScan(STAMP + i * 10**8, T, True, "max_speed" if i == 1 else None, 0.001, 0.002)


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_everything_is_on_disk_before_the_end(tmp_path):
    log = DriveLog(tmp_path / "drive", ["voxel", "range"])
    for i in range(3):
        log.scan(step(i), 0.0123)
    log.choice(Choice(STAMP, Selection(4, {"voxel": 0.5}), 0.004))
    log.choice(Choice(STAMP, Selection(7, {"range": 9}, {4: 0.25, 7: 0.75}), 0.03, "too late"))
    found = read_tum(tmp_path / "drive/trajectory.tum")
    assert found.stamps.tolist() == [STAMP, STAMP + 10**8, STAMP + 2 * 10**8]
    assert found.T_world_sensor[:, 0, 3].tolist() == [0.0, 0.5, 1.0]
    frames = rows(tmp_path / "drive/frames.csv")
    assert [(row["restarted"], row["late_ms"]) for row in frames] == [
        ("0", "12.3"),
        ("1", "12.3"),
        ("0", "12.3"),
    ]
    first, second = rows(tmp_path / "drive/selections.csv")
    assert (first["trial"], first["voxel"], first["range"], first["why_not"]) == (
        "4",
        "0.5",
        "",
        "",
    )
    assert (second["weights"], second["range"]) == ("4:0.250 7:0.750", "9")
    assert (second["why_not"], second["ms"]) == ("too late", "30.000")
    log.close()


def test_a_full_disk_ends_the_log_and_not_the_drive(tmp_path, caplog):
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    log = DriveLog(tmp_path / "drive", [])
    log.scan(step(0), 0.01)
    log._files["frames.csv"] = open("/dev/full", "w", buffering=1)  # noqa: SIM115, PTH123
    for i in range(1, 4):
        log.scan(step(i), 0.01)
    log.close()
    assert "No space left on device" in log.lost
    assert len(caplog.messages) == 1
    assert "nothing more is recorded" in caplog.text
    assert "the drive goes on" in caplog.text
    # What was there stays whole.
    assert len(read_tum(tmp_path / "drive/trajectory.tum")) == 2
    assert len(rows(tmp_path / "drive/frames.csv")) == 1


def test_a_run_is_read_as_it_was(tmp_path):
    first = Selection(7, {"range": 9.0, "kernel": "huber"}, {4: 0.25, 7: 0.75}, 0.5, state="lost")
    # Of another odometry, which has other parameters.
    second = Selection(4, {"voxel": 0.5}, {4: 1.0, 7: 0.0}, estimated_error=2.5, state="good")
    choices = [Choice(STAMP, first, 0.004), Choice(STAMP + 10**8, second, 0.005)]
    refused = Choice(STAMP, first, 0.0, "not confirmed in time")
    members = {4: "works", 7: "lost"}, {4: "works", 7: "rests"}, {}
    steps = [step(i)._replace(states=members[i]) for i in range(3)]
    run = Run(1.0, steps=steps, choices=choices, rejected=[refused])
    run.cpu_ms, run.late = 1.25, [0.0123] * 3
    write_run(tmp_path, run, {"parameters": None})
    again = read_run(tmp_path)
    np.testing.assert_array_equal(again.trajectory.stamps, run.trajectory.stamps)
    np.testing.assert_allclose(again.trajectory.T_world_sensor, run.trajectory.T_world_sensor)
    assert again.restarted.tolist() == [False, True, False]
    assert tuple(one.states for one in again.steps) == members
    assert [choice.selection.state for choice in again.choices] == ["lost", "good"]
    assert again.choice_stamps.tolist() == [STAMP, STAMP + 10**8]
    assert again.weights == run.weights == {4: [0.25, 1.0], 7: [0.75, 0.0]}
    np.testing.assert_array_equal(again.estimated, run.estimated)
    assert again.values["kernel"] == run.values["kernel"] == ["huber", ""]
    np.testing.assert_array_equal(again.values["voxel"], [np.nan, 0.5])
    np.testing.assert_allclose(again.late, run.late)
    assert again.summary == run.summary.model_copy(update={"inputs": {"parameters": None}})
    assert again.summary.lost_seconds == 0.1


@pytest.mark.parametrize("cell", ["4:flies", "x:works", "4works", "4:"])
def test_what_no_member_can_do_is_told_with_the_file(tmp_path, cell):
    run = Run(steps=[step(i)._replace(states={4: "late"}) for i in range(3)], cpu_ms=1.0)
    write_run(tmp_path, run, {"parameters": {"voxel": 0.5}})
    path = tmp_path / "frames.csv"
    path.write_text(path.read_text().replace("4:late", cell, 1))
    with pytest.raises(StoredReplayError, match=rf"frames.csv: is damaged \('{cell}'"):
        read_run(tmp_path)


def test_replays_of_before_do_not_say_what_members_did(tmp_path):
    run = Run(steps=[step(i)._replace(states={4: "works"}) for i in range(3)], cpu_ms=1.0)
    write_run(tmp_path, run, {"parameters": {"voxel": 0.5}})
    path = tmp_path / "frames.csv"
    lines = [line.rpartition(",")[0] for line in path.read_text().splitlines()]
    path.write_text("\n".join(lines) + "\n")
    assert [one.states for one in read_run(tmp_path).steps] == [{}] * 3


def test_a_run_that_keeps_its_set_has_it_as_its_only_choice(tmp_path):
    run = Run(steps=[step(i) for i in range(3)], cpu_ms=1.0)
    write_run(tmp_path, run, {"parameters": {"voxel": 0.5, "deskew": True}})
    again = read_run(tmp_path)
    assert again.values == {"voxel": [0.5], "deskew": ["True"]}
    assert (again.choice_stamps.tolist(), again.weights) == ([STAMP], {})
    assert again.summary.selections == 0
