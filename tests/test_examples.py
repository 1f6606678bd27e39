"""What README and documentation say to type works: commands, Python and YAML."""

import re
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from textwrap import dedent
from typing import Any

import click
import drives
import numpy as np
import pandas as pd
import pytest
from commands import call
from typer.main import get_command

from adaptune import files
from adaptune.commands.cli import app
from adaptune.model import BankSettings, PairedSettings
from adaptune.odometry.registry import declare_here
from adaptune.recording import SequenceConfig
from adaptune.trajectory import read_tum
from offline.config import OfflineStudyConfig, load_study
from offline.train import train
from online.modes import run_replays

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = re.compile(r"--ros|--cluster|import-rustle|configs/|adaptune tune|tuned.yaml")
"""Lines of commands that other tests run: with ROS, a cluster, RUSTLE's files, the demo."""
QUICKER = {"online.real_time.rate=1": "online.real_time.rate=50"}


def blocks(language: str) -> list[tuple[str, str]]:
    """Code blocks of a language, each with the name of its page."""
    found = []
    for page in PAGES:
        text = page.read_text("utf-8")
        code = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        if language == "sh":
            code += re.findall(r"(?<=\n\n)((?:^    adaptune .*\n)+)", text, re.MULTILINE)
        found += [(page.name, block) for block in code]
    return found


def lines() -> list[tuple[str, list[str]]]:
    """Every command of adaptune's in the pages, in words, with the name of its page."""
    return [
        (page, shlex.split(line.strip(), comments=True))
        for page, block in blocks("sh")
        for line in block.splitlines()
        if line.strip().startswith("adaptune ")
    ]


def written_to(words: list[str]) -> list[str]:
    """Words of a command without the file that its output goes to."""
    return words[: words.index(">")] if ">" in words else words


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working folder of a reader: a study `my.yaml` of short drives, and bags."""
    monkeypatch.chdir(tmp_path)
    text = drives.write_study(tmp_path).read_text()
    text = re.sub(r"\bthree:", "home:", text).replace("[three]", "[home]")
    text = text.replace("trials: 10, initial: 4, batch: 4", "trials: 6, initial: 3, batch: 3")
    (tmp_path / "my.yaml").write_text(text)
    for name in ("my.bag", "drive.bag"):
        shutil.copy(tmp_path / "three.bag", tmp_path / name)
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_commands_are_understood():
    group: Any = get_command(app)
    understood = 0
    for page, (_, name, *arguments) in lines():
        try:
            group.commands[name].make_context(name, written_to(arguments))
        except click.ClickException as error:
            pytest.fail(f"{page}: adaptune {name} {shlex.join(arguments)}: {error.message}")
        understood += 1
    assert understood > 25


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    "pages", ["quickstart|reference|your-bag", pytest.param(".", marks=pytest.mark.services)]
)
def test_commands_work(pages):
    # The guide begins with the quickstart, whose commands make what the others show.
    order = sorted(lines(), key=lambda line: line[0] != "quickstart.md")
    order = [line for line in order if re.match(pages, line[0])]
    order = [line for line in order if not ELSEWHERE.search(" ".join(line[1]))]
    assert len(order) >= 10
    for page, words in order:
        if set(QUICKER).intersection(words):
            # What was replayed in lockstep is not compared with what is replayed in real time.
            shutil.rmtree("runs/my/replays")
        if "gicp.yaml" in words:
            for name in ("gicp", "ndt"):
                shutil.copy("my.yaml", f"{name}.yaml")
                shutil.copytree("runs/my", f"runs/{name}")
        result = call(*(QUICKER.get(word, word) for word in written_to(words[1:])))
        assert result.exit_code == 0, f"{page}: {shlex.join(words)}\n{result.output}"
        assert result.output


def test_the_readme_s_example_is_what_adaptune_online_does(folder):
    overrides = ["online.switching.mechanism=bank"]
    study = load_study(folder / "my.yaml", overrides)
    model = train(study).model
    (example,) = (code for page, code in blocks("python") if page == "README.md")
    example = example.replace('"my.yaml"', f'"my.yaml", {overrides}')
    last = "    T_odom_sensor = tracker.register(scan).T_odom_sensor\n"
    assert last in example
    for bank in (True, False):
        settings = BankSettings() if bank else BankSettings(adapt=False)
        replace(model, paired=PairedSettings(), bank_settings=settings).save(study.model_path)
        run_replays(study, study.model_path)
        poses = []
        exec(example.replace(last, last + "    poses.append(T_odom_sensor)\n"), {"poses": poses})
        replays = study.folder / "replays/home/adaptive"
        replayed = read_tum(replays / "trajectory.tum")
        np.testing.assert_allclose(replayed.T_world_sensor, poses, atol=1e-8)
        assert (":" in (replays / "selections.csv").read_text()) is bank


@pytest.mark.usefixtures("folder")
def test_python_works():
    # The README's is run and compared above; this one trains the study of the others.
    found = sorted(blocks("python"), key=lambda block: block[0] != "python.md")
    found = [(page, code) for page, code in found if page != "README.md"]
    assert len(found) > 5
    for page, code in found:
        quicker = re.sub(r"length(\"?[=:]) ?\d+", r"length\1 10", code)
        names: dict[str, Any] = {"__name__": page}
        with pd.option_context("plotting.backend", "plotly"):
            exec(compile(quicker, page, "exec"), names)
        if page == "python.md":
            assert (names["errors"] < 30.0).any()
            assert {"trial", "keyframe_interval", "mean"} <= set(names["trials"])
            assert sum(names["selection"].weights.values()) == pytest.approx(1.0)
            shown = {key: repr(names[key]) for key in ("study", "home", "record")}
            shown |= {"model": repr(names["trained"].model), "space": repr(names["study"].odometry)}
            assert all(" object at 0x" not in text and len(text) < 600 for text in shown.values())
            assert shown["record"] == "<ReplayRecord: 40 scans, 0 selections, 0 restarts>"


@pytest.mark.parametrize(("page", "block"), blocks("yaml"), ids=[p for p, _ in blocks("yaml")])
def test_yaml_is_valid(page, block, tmp_path, monkeypatch):
    if "my_descriptors" in block:
        (code,) = (code for _, code in blocks("python") if "def range_deciles" in code)
        (tmp_path / "my_descriptors.py").write_text(code)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
        monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("RECORDINGS", "/data")
    data = files.Document(dedent(block)).data
    study = {"odometry": "gicp", "training": ["a"]}
    recording = {"bag": "a.bag"}
    fields = OfflineStudyConfig.model_fields
    if page == "docker.md" and "play" in data:
        settings = {"image": "a", "template": "a.yaml", "odometry": "/odometry"} | data
        assert declare_here("rustle", settings).mistakes == []
    elif set(data) <= set(SequenceConfig.model_fields):
        SequenceConfig.model_validate(recording | data)
    elif set(data) <= set(fields):
        OfflineStudyConfig.model_validate(study | data)
    else:
        for entry in data.values():
            SequenceConfig.model_validate(entry)
