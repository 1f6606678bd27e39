"""The limits that keep files and functions small; ruff knows that of parameters."""

import ast
import subprocess
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("adaptune", "offline", "online")
SOURCES = (*PACKAGES, "benchmarks", "docker")
MAX_FILE_LINES, MAX_FUNCTION_LINES = 800, 60


def tracked(*folders: str) -> list[str]:
    """Python files of folders: those that git tracks, or all outside a repository."""
    listed = subprocess.run(
        ["git", "ls-files", *(f"{folder}/*.py" for folder in folders)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    ).stdout.split()
    found = listed or [
        str(path.relative_to(ROOT)) for folder in folders for path in (ROOT / folder).rglob("*.py")
    ]
    # A file that was just removed is still in the index.
    return sorted(file for file in found if (ROOT / file).exists())


def breaches(file: str) -> list[str]:
    """Functions of a source file that are beyond the limit."""
    found = []
    for function in ast.walk(ast.parse((ROOT / file).read_text("utf-8"), file)):
        if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
            n = (function.end_lineno or 0) - function.lineno + 1
            if n > MAX_FUNCTION_LINES:
                found.append(f"{file}:{function.lineno} {function.name}: {n} lines")
    return found


def report(breaches: Iterable[str]) -> None:
    """Fail and list all breaches, if there are any."""
    if text := "\n".join(breaches):
        pytest.fail(text, pytrace=False)


@pytest.mark.parametrize("folder", [*SOURCES, "tests"])
def test_files_are_short(folder: str) -> None:
    lines = {file: (ROOT / file).read_text("utf-8").count("\n") for file in tracked(folder)}
    report(f"{file}: {n} lines" for file, n in lines.items() if n > MAX_FILE_LINES)


@pytest.mark.parametrize("folder", SOURCES)
def test_functions_are_short(folder: str) -> None:
    report(breach for file in tracked(folder) for breach in breaches(file))


def test_tests_import_no_private_names_of_ours() -> None:
    found = []
    for file in tracked("tests"):
        for node in ast.walk(ast.parse((ROOT / file).read_text("utf-8"), file)):
            if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] in PACKAGES:
                names = [name.name for name in node.names if name.name.startswith("_")]
                found += [f"{file}:{node.lineno} {node.module}.{name}" for name in names]
    report(found)
