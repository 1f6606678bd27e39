"""The README's example runs as it stands, and gives what `adaptune online` gives."""

import re
from dataclasses import replace
from pathlib import Path

import drives
import numpy as np
import pytest

from adaptune.model import BankSettings, ErrorModel, PairedSettings
from adaptune.trajectory import read_tum
from offline.config import load_study
from offline.train import train
from online.modes import run_replays

README = Path(__file__).parent.parent / "README.md"
(EXAMPLE,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A study `my.yaml` that is trained, and whose test sequence is `home`."""
    folder = tmp_path_factory.mktemp("readme")
    text = drives.write_study(folder).read_text()
    (folder / "my.yaml").write_text(re.sub(r"\bthree:", "home:", text).replace("[three]", "[home]"))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        train(load_study("my.yaml", ["offline.trials=6", "online.switching.mechanism=bank"]))
    return folder


@pytest.mark.parametrize("bank", [True, False])
def test_the_example_is_what_adaptune_online_does(folder, monkeypatch, bank):
    monkeypatch.chdir(folder)
    overrides = ["offline.trials=6", "online.switching.mechanism=bank"]
    study = load_study("my.yaml", overrides)
    model = ErrorModel.load(study.model_path)
    settings = BankSettings() if bank else BankSettings(adapt=False)
    replace(model, paired=PairedSettings(), bank_settings=settings).save(study.model_path)
    run_replays(study, study.model_path)
    poses = []
    example = EXAMPLE.replace('"my.yaml"', f'"my.yaml", {overrides}')
    last = "    T_odom_sensor = tracker.register(scan).T_odom_sensor\n"
    assert last in example
    exec(example.replace(last, last + "    poses.append(T_odom_sensor)\n"), {"poses": poses})
    replayed = read_tum(study.folder / "replays/home/adaptive/trajectory.tum")
    np.testing.assert_allclose(replayed.T_world_sensor, poses, atol=1e-8)
    weights = (study.folder / "replays/home/adaptive/selections.csv").read_text()
    assert (":" in weights) is bank
