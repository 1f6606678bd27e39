"""The limits that keep files and functions small; ruff knows that of parameters."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("adaptune", "offline", "online")
SOURCES = (*PACKAGES, "benchmarks", "docker")
MAX_FILE_LINES, MAX_FUNCTION_LINES = 800, 60


def nodes(folder, *kinds):
    """What of these kinds is in the Python files of a folder, each with its place."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"), path)):
            if isinstance(node, kinds):
                yield f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}", node


@pytest.mark.parametrize("folder", [*SOURCES, "tests"])
def test_files_are_short(folder):
    lines = {path: path.read_text("utf-8").count("\n") for path in (ROOT / folder).rglob("*.py")}
    assert [(str(path), n) for path, n in lines.items() if n > MAX_FILE_LINES] == []


@pytest.mark.parametrize("folder", SOURCES)
def test_functions_are_short(folder):
    found = nodes(folder, ast.FunctionDef, ast.AsyncFunctionDef)
    lengths = [(where, one.name, one.end_lineno - one.lineno + 1) for where, one in found]
    assert [function for function in lengths if function[2] > MAX_FUNCTION_LINES] == []


def test_tests_import_no_private_names_of_ours():
    found = [
        (where, name.name)
        for where, node in nodes("tests", ast.ImportFrom)
        if str(node.module).split(".")[0] in PACKAGES
        for name in node.names
        if name.name.startswith("_")
    ]
    assert found == []
