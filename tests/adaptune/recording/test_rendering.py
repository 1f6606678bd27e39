from pathlib import Path

import pytest
from rich.console import Console
from small_bag import drive

from adaptune.recording import SequenceConfig
from adaptune.recording.inspect import render_cache
from adaptune.recording.recording import open_sequence


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))


def test_the_cache_is_listed(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0, 0.1], [])
    list(open_sequence(SequenceConfig(bag=str(bag))))
    console = Console(width=500)
    with console.capture() as capture:
        console.print(render_cache())
    assert str(bag) in capture.get()
    assert "GB of at most" in capture.get()
