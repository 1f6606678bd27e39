import numpy as np
from rich.console import Console

from adaptune.commands.terminal import Dashboard
from adaptune.odometry.tracker import RegisteredScan
from adaptune.space import Selection
from online.replay import Choice, ReplayRecord

TENTH = 10**8
SET = Selection(
    7,
    {"voxel_size": 0.5, "kernel": "huber"},
    predicted_error=0.42,
    predicted_fixed=0.55,
    estimated_error=0.5,
    estimated_low=0.4,
    estimated_high=0.65,
)


def step(i, unhealthy=None):
    return RegisteredScan(i * TENTH, np.eye(4), True, unhealthy, 0.004, 0.006)


def shown(dashboard):
    console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    console.print(dashboard)
    lines = (line.rstrip() for line in console.export_text().splitlines())
    return dict(line.split(maxsplit=1) for line in lines if line)


def test_a_single_odometry_in_lockstep():
    dashboard, record = Dashboard(), ReplayRecord()
    record.note(Choice(0, SET, 0.005))
    for i in range(21):
        record.begin()
        record.end(step(i, "max_speed" if i == 9 else None))
        dashboard.look("home", 100, record)
    found = shown(dashboard)
    assert found["home"].startswith("2.0 s driven, ")
    assert found["home"].endswith(" times as fast as recorded")
    assert found["scans"] == "21 of 100, restarted 1 times; 10.0 ms (99 %: 10.0) a scan"
    assert found["selections"] == "5.0 ms (99 %: 5.0); not applied: 0"
    assert found["chosen"] == "trial 7: voxel_size 0.5, kernel huber"
    assert found["predicted"] == "0.420 %, of the fixed set 0.550 %"
    assert found["measured"] == "0.500 % (0.400-0.650 %)"
    assert not {"latency", "lost", "warning", "weights"} & set(found)


def test_a_bank_in_real_time_that_is_lost():
    dashboard = Dashboard()
    record = ReplayRecord(1.0, dropped=3, missed=1, late=[0.02] * 50)
    lost = SET._replace(weights={7: 0.25, 3: 0.75}, lost=True, estimated_error=np.nan)
    record.note(Choice(0, lost, 0.03, "too late"))
    record.begin()
    record.end(step(0))
    dashboard.look("home", 0, record)
    found = shown(dashboard)
    assert found["scans"].startswith("4; ")
    late = "pose 20.0 ms (99 %: 20.0) after the scan"
    assert found["latency"] == f"{late}; scans dropped: 3, selections missed: 1"
    assert found["selections"].endswith("; not applied: 1")
    assert found["weights"] == "trial 3 75 %, trial 7 25 %"
    assert found["lost"] == "do not rely on the pose"
    assert found["warning"] == "too late"
    assert "measured" not in found
