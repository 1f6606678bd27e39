from pathlib import Path

import pytest
from rich.console import Console
from small_bag import drive

from adaptune.inspect import inspect
from adaptune.rendering import render_cache, write_inspection_png
from adaptune.sequence import SequenceConfig
from adaptune.sequence.opening import open_sequence


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))


def test_the_picture_is_one(tmp_path: Path) -> None:
    write_inspection_png(inspect(drive(tmp_path / "a.bag", [0, 0.1], [])), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(p.suffix for p in tmp_path.iterdir()) == [".bag", ".png"]


def test_the_cache_is_listed(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0, 0.1], [])
    list(open_sequence(SequenceConfig(bag=str(bag))))
    console = Console(width=500)
    with console.capture() as capture:
        console.print(render_cache())
    assert str(bag) in capture.get()
    assert "GB of at most" in capture.get()
