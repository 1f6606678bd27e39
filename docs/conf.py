"""The documentation as a site: `make docs` builds it with Sphinx, with warnings as errors.

The pages are plain Markdown. Three comments in them mark where a reference goes that is made from
the code here: ``<!-- commands -->``, ``<!-- settings -->`` and ``<!-- python -->``.
"""

import json
import re
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import click
from typer.main import get_command

import adaptune
from adaptune.commands.cli import app
from offline.config import OfflineStudyConfig

project = "adaptune"
version = release = adaptune.__version__
root_doc = "README"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns: list[str] = []
myst_heading_anchors = 4
html_theme = "furo"
html_title = "adaptune"
html_copy_source = False
html_show_copyright = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
autodoc_default_options = {"exclude-members": "model_config"}
napoleon_google_docstring = False
napoleon_use_ivar = True
default_role = "code"

LINK = re.compile(r"\]\(([\w/-]+)\.md[#)]")
OBJECTS = """
adaptune.tuning.tuned: tune Tuned
adaptune.evaluation.evaluated: evaluate Evaluation
adaptune.evaluation.judged: Judged
adaptune.recording: Scan Imu SequenceConfig
adaptune.recording.recording: open_sequence
adaptune.trajectory: Trajectory read_trajectory read_tum write_tum read_kitti
adaptune.metrics: sub_trajectory_rte kitti_error absolute_error relative_error
adaptune.space: Float Integer Categorical ParameterSpace ParameterSets Selection
adaptune.odometry: Odometry Registration InProcess
adaptune.odometry.tracker: Tracker HealthCheck
adaptune.runs.archive: Archive Trial
adaptune.model: ErrorModel
adaptune.selector: Selector TimedSelector
adaptune.errors: AdaptuneError
offline.config: load_study
offline.train: train Training
offline.scenario: scenario Scenario read_scenario write_scenario
offline.annealing: AnnealingSampler
online.modes: ReplaySetup
adaptune.runs.loop: replay
adaptune.runs.record: Run
"""
"""What the Python reference describes, by module."""


# References that are made from the code.


def commands() -> str:
    """Every command with its arguments and options, as the command line knows them."""
    group: Any = get_command(app)
    return "\n\n".join(map(command, group.commands.values()))


def command(one: click.Command) -> str:
    """A command: what it does, how it is called, and a table of what may follow it."""
    context = click.Context(one, info_name=f"adaptune {one.name}")
    rows = [
        (", ".join(f"`{name}`" for name in names(parameter)), about(parameter))
        for parameter in one.params
    ]
    usage = f"```text\n{one.get_usage(context).removeprefix('Usage: ')}\n```"
    return "\n\n".join([f"### {one.name}", one.help or "", usage, table("", "", rows)])


def names(parameter: click.Parameter) -> list[str]:
    """How a parameter of a command is written."""
    if isinstance(parameter, click.Argument):
        return [parameter.human_readable_name]
    return [*parameter.opts, *parameter.secondary_opts]


def about(parameter: Any) -> str:
    """What a parameter of a command means, and its default."""
    default = parameter.show_default if isinstance(parameter.show_default, str) else None
    if default is None and parameter.default not in (None, False, ()):
        default = str(parameter.default)
    return (parameter.help or "") + (f" Default: {default}." if default else "")


def settings() -> str:
    """Every key of a study, with the values that it takes and its default, from the schema."""
    schema = OfflineStudyConfig.model_json_schema()
    rows = [(f"`{key}`", *rest) for key, *rest in keys(schema, schema["$defs"], "")]
    return table("key", "value", "default", rows)


def keys(
    model: dict[str, Any], models: dict[str, Any], prefix: str
) -> Iterator[tuple[str, str, str]]:
    """Keys of a model of the schema and of those in it: name, values, default."""
    for name, field in model["properties"].items():
        plain = {}
        for part in (resolved(part, models) for part in field.get("anyOf", [field])):
            below, inner = f"{prefix}{name}", part
            if "items" in part:
                below, inner = f"{below}[]", resolved(part["items"], models)
            elif isinstance(part.get("additionalProperties"), dict):
                below = f"{below}.<name>"
                inner = resolved(part["additionalProperties"], models)
            if "properties" in inner:
                yield from keys(inner, models, f"{below}.")
            elif text := values(part):
                plain[text] = None
        if plain:
            default = field.get("default")
            told = "" if default is None else written(default)
            yield f"{prefix}{name}", " or ".join(plain), told


def written(value: Any) -> str:
    """A value as YAML has it."""
    return f"`{value if isinstance(value, str) else json.dumps(value)}`"


def resolved(part: dict[str, Any], models: dict[str, Any]) -> dict[str, Any]:
    """A part of a schema, or what it refers to."""
    return models[part["$ref"].rpartition("/")[2]] if "$ref" in part else part


def values(part: dict[str, Any]) -> str:
    """What a value may be."""
    if "const" in part or "enum" in part:
        choices = part.get("enum", [part.get("const")])
        return ", ".join(map(written, choices))
    words = {"number": "number", "integer": "whole number", "boolean": "true or false"}
    words |= {"string": "text", "array": "list", "object": "keys with values"}
    bounds = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most"}
    bounds |= {"exclusiveMaximum": "below"}
    given = [f"{word} {part[key]:.10g}" for key, word in bounds.items() if key in part]
    kind = words.get(part.get("type", ""), "")
    return ", ".join([kind, *given]) if kind else ""


def python() -> str:
    """The public objects, from their docstrings."""
    made = []
    for line in OBJECTS.strip().splitlines():
        module, _, names = line.partition(":")
        made.append(f"### {module}")
        for name in names.split():
            found = getattr(import_module(module), name)
            kind = "autoclass" if isinstance(found, type) else "autofunction"
            members = "\n   :members:" if kind == "autoclass" else ""
            made.append(f"```{{eval-rst}}\n.. {kind}:: {module}.{name}{members}\n```")
    return "\n\n".join(made)


def table(*heads_and_rows: Any) -> str:
    """A table in Markdown: its heads, then its rows."""
    *heads, rows = heads_and_rows
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(map(cell, line)) + " |" for line in lines)


def cell(text: str) -> str:
    """Text of a table's cell."""
    return " ".join(text.replace("|", "\\|").split())


MADE: dict[str, Callable[[], str]] = {
    "<!-- commands -->": commands,
    "<!-- settings -->": settings,
    "<!-- python -->": python,
}


# Sphinx asks here.


def complete(_: Any, page: str, text: list[str]) -> None:
    """Fill in the references; a page that lists others becomes their table of contents."""
    for mark, made in MADE.items():
        if mark in text[0]:
            text[0] = text[0].replace(mark, made())
    if page.endswith("README"):
        text[0] += "\n".join(map(contents, re.split(r"^## ", text[0], flags=re.MULTILINE)))


def contents(section: str) -> str:
    """Table of contents of the pages that a section lists."""
    title = section.partition("\n")[0]
    caption = [] if title.startswith("#") else [f":caption: {title}"]
    listed = dict.fromkeys(LINK.findall(section))
    return "\n".join(["", "```{toctree}", ":hidden:", *caption, "", *listed, "```", ""])


def setup(sphinx: Any) -> None:
    """Register what completes the pages."""
    sphinx.connect("source-read", complete)
