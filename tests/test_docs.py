"""The documentation leads where it says, and names commands that exist."""

import re
import sys
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import drives
import numpy as np
import pytest
from needs import module_of
from setups import setup_of
from typer.main import get_command

from adaptune.commands.cli import app
from offline.config import OfflineStudyConfig, load_study

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
GUIDE = [page for page in (ROOT / "docs").glob("*.md") if page.stem != "README"]
CODE = re.compile(r"^```.*?^```|^    .*?$|`[^`\n]+`", re.MULTILINE | re.DOTALL)
HEADING = re.compile(r"^#+ (.+)$", re.MULTILINE)


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


def test_index_lists_the_whole_guide():
    assert set(GUIDE) <= targets(ROOT / "docs/README.md")
    assert ROOT / "docs/README.md" in targets(ROOT / "README.md")


def test_index_lists_all_research_notes():
    index = ROOT / "docs/research/README.md"
    assert set(index.parent.glob("*.md")) - {index} <= targets(index)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_exist(page):
    code = "\n".join(CODE.findall(page.read_text(encoding="utf-8")))
    named = set(re.findall(r"(?:^|[\s`/])adaptune ([a-z]+(?:-[a-z]+)*)\b", code))
    assert named <= set(get_command(app).commands)


def test_the_guide_is_short():
    pages = [page for page in (ROOT / "docs").glob("*.md") if page.stem != "benchmarks"]
    assert sum(len(page.read_text("utf-8").split()) for page in pages) <= 20_000


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


def test_the_example_of_an_odometry_follows_a_drive():
    (example,) = re.findall(
        r"^```python\n(import small_gicp.*?)^```",
        (ROOT / "docs/your-odometry.md").read_text(encoding="utf-8"),
        re.MULTILINE | re.DOTALL,
    )
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
    _, rest = study_file.read_text().split("sequences:")
    rest = rest.replace("bag: ", f"bag: {study_file.parent}/")
    (tmp_path / "study.yaml").write_text(f"{example}sequences:{rest}")
    setup = setup_of(load_study(tmp_path / "study.yaml", runs=tmp_path / "runs"))
    (trial,) = setup.run(setup.prepare("one", 1e9), [{"mapping.voxel_size": 0.5}])
    assert not trial.faults
    assert np.nanmean(trial.errors) < 5.0
