import csv
from pathlib import Path

import numpy as np
import pytest

from adaptune.odometry.tracker import RegisteredScan
from adaptune.space import Selection
from adaptune.trajectory import read_tum
from online.replay import Choice
from online.robot import DriveLog

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
