"""Benchmarks that run with nothing but their argument."""

import importlib.util
import os
from pathlib import Path
from types import SimpleNamespace

from offline.offline_study import OfflineStudy


def test_stages_needs_its_argument_only(recorded, monkeypatch):
    path = Path(__file__).parents[1] / "benchmarks/stages.py"
    spec = importlib.util.spec_from_file_location("stages", path)
    stages = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(stages)
    measured: list[OfflineStudy] = []
    monkeypatch.setenv("ADAPTUNE_TEST_DATA", "to be restored")
    os.environ.pop("ADAPTUNE_TEST_DATA")
    monkeypatch.setattr(stages.cores, "pin", lambda _: None)
    monkeypatch.setattr(stages, "trial", measured.append)
    monkeypatch.setattr(stages, "train", lambda _: SimpleNamespace(model=None))
    monkeypatch.setattr(stages, "adaptive_replay", lambda study, _: measured.append(study))
    monkeypatch.chdir(recorded.parent)
    stages.main(Path(recorded.name))
    bags = {sequence.bag for study in measured for sequence in study.config.sequences.values()}
    assert {Path(bag).resolve() for bag in bags} == {
        (recorded / name).resolve() for name in ("hall.bag", "street.bag")
    }
