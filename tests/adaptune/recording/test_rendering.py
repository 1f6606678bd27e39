from pathlib import Path

import pytest
from pictures import texts
from rich.console import Console
from small_bag import START, cloud, drive, write

from adaptune.recording import SequenceConfig
from adaptune.recording.inspect import draw_inspection, inspect, render_cache
from adaptune.recording.recording import open_sequence


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))


def test_the_picture_is_one(tmp_path: Path) -> None:
    bag = write(tmp_path / "a.bag", [("/points", START, cloud(START, 5000))])
    inspection = inspect(bag)
    for name in ("a.png", "a.svg"):
        draw_inspection(inspection, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    said = texts(tmp_path / "a.png")
    assert {"x [m]", "y [m]", "z [m]", "height z [m]", "LiDAR"} <= set(said)
    assert "times spanning 0.1000 s, no rings" in " ".join(said)
    assert "drawn within 2" in " ".join(said)  # where few far points are cut off
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".bag", ".png", ".svg"]


def test_the_cache_is_listed(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0, 0.1], [])
    list(open_sequence(SequenceConfig(bag=str(bag))))
    console = Console(width=500)
    with console.capture() as capture:
        console.print(render_cache())
    assert str(bag) in capture.get()
    assert "GB of at most" in capture.get()
