import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter
from rich.console import Console
from small_bag import START, cloud, drive, pose, write

from adaptune import yaml
from adaptune.inspect import inspect
from adaptune.rendering import render_inspection, write_inspection_png
from adaptune.sequence import SequenceConfig, SequenceError
from adaptune.sequence.opening import open_sequence


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))


def inspection_text(inspection: Any, width: int = 100) -> str:
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(render_inspection(inspection))
    return capture.get()


def entry(inspection: Any) -> dict[str, SequenceConfig]:
    """The proposed entry, read back as a study would."""
    data = yaml.Document(inspection.entry).data["sequences"]
    return TypeAdapter(dict[str, SequenceConfig]).validate_python(data)


def test_a_sound_bag_has_all_it_needs_and_an_entry_that_opens(tmp_path: Path) -> None:
    seconds = [0.1 * i for i in range(10)]
    bag = drive(tmp_path / "my drive.bag", seconds, [(s, s) for s in seconds])
    inspection = inspect(bag)
    points = next(topic for topic in inspection.topics if topic.name == "/points")
    assert points.count == 10
    assert points.rate == pytest.approx(10)
    assert points.gap == pytest.approx(0.1)
    assert inspection.layout[3] == ("time", "float32", 12)
    assert inspection.scan is not None
    assert len(inspection.scan.scan) == 195
    assert inspection.scan.recorded == 200
    assert inspection.scan.span == pytest.approx(0.1)
    assert inspection.problems == ()
    assert not inspection.missing["offline"]
    assert not inspection.missing["motion compensation"]
    ((name, config),) = entry(inspection).items()
    assert name == "my_drive"
    sequence = open_sequence(config)
    assert len(list(sequence)) == 10
    assert sequence.reference() is not None
    text = inspection_text(inspection)
    for expected in ("/points", "195 points of 200", "10.00 Hz", "0.9 m in 0.9 s", str(bag)):
        assert expected in text.replace("\n", "")


@pytest.mark.parametrize(
    ("stamps", "poses", "expected"),
    [
        ([0, 0.1, 0.1, 0.3], [], "/points: 1 stamps repeat the one before"),
        ([0, 0.2, 0.1, 0.3], [], "/points: 1 stamps go back in time"),
        ([0, 0.1, 0.2, 2.3, 2.4], [], "/points: 1 gaps, the longest of 2.10 s"),
        ([-100.0, -99.9, -99.8], [], "/points: its clock is 100.000 s behind the recorder's"),
        ([0, 0.1, 90, 0.3], [], "/points: 1 stamps leap by more than 5 s"),
        ([0, 0.1], [(0, 0), (0.1, 0), (0.2, 1)], "repeats the pose before it 1 times"),
        ([0, 0.1], [(0, 0), (0.1, 500)], "the reference jumps 1 times"),
        ([0, 0.1], [(0, 0), (5, 1)], "the reference has 1 gaps beyond 1 s, the longest of 5.00 s"),
        ([0, 0.1], [(0, 0)], "the reference holds a single pose"),
        ([0, 0.1], [(50, 0), (60, 0)], "set `clock_offset`"),
    ],
)
def test_oddities_are_reported(
    tmp_path: Path, stamps: list[float], poses: list[tuple[float, float]], expected: str
) -> None:
    inspection = inspect(drive(tmp_path / "a.bag", stamps, poses))
    assert any(expected in problem for problem in inspection.problems), inspection.problems
    assert expected[:20] in inspection_text(inspection, width=1000)


def test_what_is_missing_is_reported(tmp_path: Path) -> None:
    inspection = inspect(write(tmp_path / "a.bag", [("/poses", START, pose(START, 0))]))
    assert inspection.missing["online"] == ("point clouds that can be read",)
    assert inspection.scan is None
    with pytest.raises(SequenceError, match="no scan can be drawn"):
        write_inspection_png(inspection, tmp_path / "a.png")
    inspection_text(inspection)


def test_a_cloud_that_cannot_be_decoded_is_a_problem_not_a_crash(tmp_path: Path) -> None:
    broken = cloud(START)
    broken.fields = broken.fields[:2]
    inspection = inspect(write(tmp_path / "a.bag", [("/points", START, broken)]))
    assert inspection.scan is None
    assert any("no field z; there is x, y" in problem for problem in inspection.problems)


def test_files_that_are_no_recording_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("text")
    for path, message in [
        (tmp_path / "none.bag", "there is no such file or folder"),
        (tmp_path / "a.txt", "not a bag"),
        (tmp_path, "holds no scan"),
    ]:
        with pytest.raises(SequenceError, match=message):
            inspect(path)


def test_folders_are_inspected_too(tmp_path: Path) -> None:
    for i in range(4):
        np.save(tmp_path / f"{i}.npy", np.ones((10, 3), np.float32) * (i + 1))
    inspection = inspect(tmp_path)
    assert inspection.topics[0].count == 4
    assert inspection.topics[0].rate == pytest.approx(10)
    assert not inspection.problems
    assert len(list(open_sequence(next(iter(entry(inspection).values()))))) == 4


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (
            "botanic_garden_scan.bag",
            SimpleNamespace(points=24_859, rings=16, brightest=158, reference=False),
        ),
        (
            "hilti_2022_scan.bag",
            SimpleNamespace(points=57_456, rings=32, brightest=255, reference=False),
        ),
        ("hall.bag", SimpleNamespace(points=36_726, rings=None, brightest=None, reference=True)),
        ("street.bag", SimpleNamespace(points=21_658, rings=32, brightest=0, reference=False)),
    ],
)
def test_recorded_data(name: str, expected: Any) -> None:
    folder = os.environ.get("ADAPTUNE_TEST_DATA")
    if not folder:
        pytest.skip("ADAPTUNE_TEST_DATA is not set: no recorded data to read")
    inspection = inspect(Path(folder) / name)
    assert inspection.scan is not None
    assert len(inspection.scan.scan) == expected.points
    assert inspection.scan.rings == expected.rings
    light = inspection.scan.scan.intensities
    assert (None if light is None else light.max()) == expected.brightest
    assert (inspection.reference is not None) == expected.reference
    assert not inspection.problems
    open_sequence(next(iter(entry(inspection).values())))
