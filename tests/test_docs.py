"""The documentation leads where it says, and what it says to type works: commands, Python, YAML."""

import inspect
import json
import re
import shlex
import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace
from typing import Any

import click
import drives
import numpy as np
import pandas as pd
import pytest
from commands import call
from made_drives import trials_of
from needs import module_of
from setups import setup_of
from typer.main import get_command

import adaptune
from adaptune._system import yaml12
from adaptune._system.strict import ConfigurationError
from adaptune.commands.cli import app
from adaptune.model import BankSettings, FixedSet
from adaptune.odometry.portfolio import Portfolio
from adaptune.odometry.registry import ODOMETRIES, declare_here
from adaptune.recording import SequenceConfig
from adaptune.trajectory import read_tum
from offline.config import OfflineStudyConfig, load_study
from offline.train import train
from online.modes import Replays, run_replays

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
GUIDE = [page for page in (ROOT / "docs").glob("*.md") if page.stem != "README"]
CODE = re.compile(r"^```.*?^```|^    .*?$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)
ELSEWHERE = re.compile(
    r"--ros|--cluster|import-rustle|configs/|adaptune (tune|evaluate|watch)|tuned.yaml|_ros2|bags/"
    r"|--against"
)
"""Lines of commands that other tests run: with ROS, a cluster, RUSTLE's files, the demo."""
QUICKER = {"online.real_time.rate=1": "online.real_time.rate=50"}


def without_code_blocks(page: Path) -> str:
    text = page.read_text(encoding="utf-8")
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def links(page: Path) -> list[str]:
    found = re.findall(r"\]\(([^)\s]+)\)", without_code_blocks(page))
    return [link for link in found if not re.match(r"[a-z]+:", link)]


def targets(page: Path) -> set[Path]:
    return {(page.parent / link.partition("#")[0]).resolve() for link in links(page)}


@cache
def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = HEADING.findall(without_code_blocks(page))
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_anchors_exist(page):
    broken = []
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


def test_indexes_list_all_pages():
    for index in (ROOT / "docs/README.md", ROOT / "docs/research/README.md"):
        assert set(index.parent.glob("*.md")) - {index} <= targets(index)
    assert ROOT / "docs/README.md" in targets(ROOT / "README.md")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_exist(page):
    code = "\n".join(CODE.findall(page.read_text(encoding="utf-8")))
    named = set(re.findall(r"(?:^|[\s`/])adaptune ([a-z]+(?:-[a-z]+)*)\b", code))
    assert named <= set(get_command(app).commands)


def test_every_odometry_has_a_row():
    page = (ROOT / "docs/odometries.md").read_text("utf-8")
    ours = {name for name in ODOMETRIES if ":" not in name}
    assert ours <= set(re.findall(r"(?m)^\| `(\w+)` \|", page))


def test_the_guide_is_short():
    pages = [page for page in (ROOT / "docs").glob("*.md") if page.stem != "benchmarks"]
    assert sum(len(page.read_text("utf-8").split()) for page in pages) <= 18_000


def test_the_site_lists_all_keys_commands_and_objects():
    made = {mark: text() for mark, text in module_of("docs/conf.py").MADE.items()}
    pages = "".join(page.read_text("utf-8") for page in GUIDE)
    assert all(pages.count(mark) == 1 for mark in made)
    keys = made["<!-- settings -->"]
    assert "| `sequences.<name>.imu.noise.gyroscope` | number, above 0, at most 1000000 |" in keys
    assert "| `online.switching.mechanism` | `auto`, `live`, `bank` | `auto` |" in keys
    for name in get_command(app).commands:
        assert f"### {name}\n" in made["<!-- commands -->"]
    assert "autoclass:: adaptune.selector.Selector\n" in made["<!-- python -->"]


def test_the_options_of_the_command_are_arguments_in_python():
    pages = ((ROOT / "docs" / name).read_text("utf-8") for name in ("python.md", "quickstart.md"))
    page, quickstart = pages
    options = set(re.findall(r"(?m)^\| `--(\w+) ", quickstart))
    assert {"reference"} == set(re.findall(r"`(\w+)=`", page)) <= options
    assert options <= set(inspect.signature(adaptune.tune).parameters)


def test_the_tables_of_settings_are_those_of_the_code():
    schema = OfflineStudyConfig.model_json_schema()
    keys = module_of("docs/conf.py").keys(schema, schema["$defs"], "")
    defaults = {key: told for key, _, told in keys}
    text = (ROOT / "docs/reference-study.md").read_text("utf-8")
    table = text[text.index("## The odometry") : text.index("## Objectives")]
    rows = re.findall(r"^\| (`.+?`) \| .* \| ?(.*?) \|$", table, re.MULTILINE)
    told = {key: default for keys, default in rows for key in re.findall(r"`(\S+)`", keys)}
    unknown = [key for key in told if not any(name.startswith(key) for name in defaults)]
    assert unknown == []
    given = {key: default for key, default in told.items() if re.fullmatch(r"[\d.]+", default)}
    assert len(given) > 10
    coded = {key: float(defaults[key].strip("`") or "nan") for key in given}
    assert coded == {key: float(default) for key, default in given.items()}
    missing = [key for key in defaults if not key.startswith(tuple(told))]
    assert missing == []


def blocks(language: str, pages: Sequence[Path] = ()) -> list[tuple[str, str]]:
    """Code blocks of a language, by default those of the guide, each with the name of its page."""
    found = []
    for page in pages or (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = page.read_text("utf-8")
        code = re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
        if language == "sh":
            code += re.findall(r"(?<=\n\n)((?:^    adaptune .*\n)+)", text, re.MULTILINE)
        found += [(page.name, block) for block in code]
    return found


def lines(pages: Sequence[Path] = ()) -> list[tuple[str, list[str]]]:
    """Every command of adaptune's in the pages, in words, with the name of its page."""
    found = []
    for page, block in blocks("sh", pages):
        # A quoted value may go on in the next lines.
        code = re.sub(r"\s#.*", "", block)
        whole = re.sub(r"'[^']*'", lambda quoted: " ".join(quoted[0].split()), code)
        commands = (line.strip() for line in whole.replace("\\\n", " ").splitlines())
        found += [(page, shlex.split(line)) for line in commands if line.startswith("adaptune ")]
    return found


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
    for name in ("my.bag", "drive.bag", "hall.bag"):
        shutil.copy(tmp_path / "three.bag", tmp_path / name)
    return tmp_path


@pytest.mark.usefixtures("folder")
def test_commands_are_understood():
    group: Any = get_command(app)
    understood = 0
    for page, (_, name, *arguments) in lines(PAGES):
        of = group.commands["offline" if name == "$stage" else name]
        try:
            of.make_context(of.name, written_to(arguments))
        except click.ClickException as error:
            pytest.fail(f"{page}: adaptune {name} {shlex.join(arguments)}: {error.message}")
        understood += 1
    assert understood > 45


def test_overrides_are_understood(folder):
    text = "\n".join(page.read_text("utf-8") for page in PAGES)
    given = re.findall(
        r"""(?:-o|^[A-Z]+=) ?(?:'([^']+)'|"?([a-z][\w.]*=[^\s`'"]+))""", text, re.MULTILINE
    )
    overrides = {" ".join("".join(either).split()) for either in given}
    overrides = {text for text in overrides if not text.endswith(("=...", "key=value"))}
    assert len(overrides) > 20
    # Other studies have other sequences, parameters and samplers.
    elsewhere = r"there is no sequence|has no parameter|no such setting"
    for override in sorted(overrides):
        try:
            load_study(folder / "my.yaml", [override])
        except ConfigurationError as error:
            wrong = [line for line in str(error).splitlines() if line.startswith("-o")]
            wrong = [line for line in wrong if not re.search(elsewhere, line)]
            assert wrong == [], override


@pytest.mark.usefixtures("folder")
@pytest.mark.parametrize(
    "pages", ["quickstart|reference|your-bag", pytest.param(".", marks=pytest.mark.services)]
)
def test_commands_work(pages):
    # The guide begins with the quickstart, whose commands make what the others show.
    order = sorted(lines(), key=lambda line: line[0] != "quickstart.md")
    order = [line for line in order if re.match(pages, line[0])]
    order = [line for line in order if not ELSEWHERE.search(" ".join(line[1]))]
    assert len(order) >= 8
    for page, words in order:
        if "gicp.yaml" in words:
            for name in ("gicp", "ndt"):
                shutil.copy("my.yaml", f"{name}.yaml")
                shutil.copytree("runs/my", f"runs/{name}")
        result = call(*(QUICKER.get(word, word) for word in written_to(words[1:])))
        assert result.exit_code == 0, f"{page}: {shlex.join(words)}\n{result.output}"
        assert result.output


def test_the_loop_on_a_robot_is_what_adaptune_online_does(folder):
    (text,) = (code for _, code in blocks("python") if "Driver(odometry" in code)
    last = "    T_odom_sensor = driver.register(scan).T_odom_sensor\n"
    assert last in text
    model = None
    for mechanism in ("bank", "live"):
        overrides = [f"online.switching.mechanism={mechanism}", "online.modes=[standby]"]
        study = load_study(folder / "my.yaml", overrides)
        model = model or train(study).model
        replace(model, bank_settings=BankSettings()).save(study.model_path)
        run_replays(study, study.model_path)
        poses = []
        example = text.replace('"my.yaml"', f'"my.yaml", {overrides}')
        exec(example.replace(last, last + "    poses.append(T_odom_sensor)\n"), {"poses": poses})
        replays = Replays.of(study).folder("home", "standby")
        replayed = read_tum(replays / "trajectory.tum")
        np.testing.assert_allclose(replayed.T_world_sensor, poses, atol=1e-8)
        assert (":" in (replays / "selections.csv").read_text()) is (mechanism == "bank")


@pytest.mark.usefixtures("folder")
def test_python_works():
    # The first ones train the study of the others; the README's is run with the notebook.
    found = sorted(blocks("python"), key=lambda block: block[0] != "python.md")
    found = [(page, code) for page, code in found if page != "README.md"]
    assert len(found) > 5
    for page, code in found:
        quicker = re.sub(r"length(\"?[=:]) ?\d+", r"length\1 10", code)
        names: dict[str, Any] = {"__name__": page}
        with pd.option_context("plotting.backend", "plotly"):
            exec(compile(quicker, page, "exec"), names)
        if "adaptune.tune(" in code:
            assert {"trial", "keyframe_interval", "mean"} <= set(names["tuned"].trials)
            assert repr(names["tuned"]).endswith("/runs/hall/report/report.html>")
        if "read_scenario" in code:
            assert names["errors"].score(FixedSet())[0]["RTE [%]"] > 0.0
            shown = {key: repr(names[key]) for key in ("study", "trained")}
            assert "<Study in runs/my: " in shown["study"]


@pytest.mark.services  # takes long
def test_the_notebook_runs_and_so_does_the_readme(folder, monkeypatch):
    cells = json.loads((ROOT / "docs/tune.ipynb").read_text("utf-8"))["cells"]
    codes = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert all(not cell.get("outputs") and not cell.get("execution_count") for cell in cells)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=":")
    (readme,) = (code for page, code in blocks("python") if page == "README.md")
    names: dict[str, Any] = {}
    for code in [*codes, readme.replace("budget=15", "budget=1e6")]:
        magic, _, rest = code.partition("\n")
        if magic.startswith("%%writefile "):
            (folder / magic.split()[1]).write_text(rest)
        else:
            exec(re.sub(r"trials=\d", "trials=3", code), names)
    assert names["again"].study.odometry.space.baseline == {"voxel": 0.3}
    tuned = names["tuned"]
    assert tuned.study.config.online.budget == 1e6
    assert [f"rte_{n}" for n in tuned.trials["trial"]] == list(tuned.errors.filter(like="rte_"))
    assert set(tuned.errors.attrs) == set(tuned.errors.filter(like="rte_"))
    assert tuned.errors["time"].is_monotonic_increasing
    assert {"blocks", "ratio_low", "ratio_high"} <= set(tuned.modes)
    assert '<img style="max-width: 100%" src="data:image/png;base64,' in tuned._repr_html_()
    assert {"study", "fixed", "model", "page", "trials", "comparison"} <= set(tuned.files)
    assert {"baseline", "fixed"} <= set(tuned.modes["mode"])


@pytest.mark.parametrize(("page", "block"), blocks("yaml"), ids=[p for p, _ in blocks("yaml")])
def test_yaml_is_valid(page, block, tmp_path, monkeypatch):
    if "my_descriptors" in block:
        (code,) = (code for _, code in blocks("python") if "def range_deciles" in code)
        (tmp_path / "my_descriptors.py").write_text(code)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
        monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("RECORDINGS", "/data")
    data = yaml12.Document(dedent(block)).data
    study = {"odometry": "gicp", "training": ["a"]}
    recording = {"bag": "a.bag"}
    fields = OfflineStudyConfig.model_fields
    if page == "docker.md" and "play" in data:
        settings = {"image": "a", "template": "a.yaml", "odometry": "/odometry"} | data
        assert declare_here("rustle", settings).mistakes == []
    elif page == "portfolios.md":
        Portfolio.model_validate(data)
    elif set(data) <= set(SequenceConfig.model_fields):
        SequenceConfig.model_validate(recording | data)
    elif set(data) <= set(fields):
        OfflineStudyConfig.model_validate(study | data)
    else:
        for entry in data.values():
            SequenceConfig.model_validate(entry)


def test_the_example_of_an_odometry_follows_a_drive():
    (example,) = (code for _, code in blocks("python") if code.startswith("import small_gicp"))
    names: dict[str, Any] = {}
    exec(example, names)
    scans = [points for _, points, _ in drives.scans(n_scans=6)]
    for voxel in (0.1, 1.0):
        odometry = names["Mine"]({"voxel": voxel})
        odometry.start(odometry.prepare(SimpleNamespace(points=scans[0])), np.eye(4))
        for points in scans[1:]:
            pose, registered = odometry.register(odometry.prepare(SimpleNamespace(points=points)))
        assert registered
        assert abs(pose[0, 3] - 5 * 0.3) < 0.15


def test_the_example_of_a_program_follows_a_drive(study_file, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    ((template, example),) = re.findall(
        r"`([^`]*)` in `kiss_icp\.yaml`:\n\n```yaml\n(.*?)^```",
        (ROOT / "docs/programs.md").read_text(encoding="utf-8"),
        re.MULTILINE | re.DOTALL,
    )
    (tmp_path / "kiss_icp.yaml").write_text(template)
    (tmp_path / "study.yaml").write_text(drives.study_with(example, study_file.parent))
    setup = setup_of(load_study(tmp_path / "study.yaml", folder=tmp_path / "runs/study"))
    (trial,) = trials_of(setup, [{"mapping.voxel_size": 0.5}])
    assert not trial.faults
    assert np.nanmean(trial.errors) < 5.0
