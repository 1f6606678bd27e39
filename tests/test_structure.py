"""The limits that keep files and functions small."""

import ast
import subprocess
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("adaptune", "offline", "online")
SOURCES = (*PACKAGES, "benchmarks", "docker")
MAX_FILE_LINES, MAX_FUNCTION_LINES, MAX_PARAMETERS = 800, 60, 8
MAX_OPTIONS = 12

Function = ast.FunctionDef | ast.AsyncFunctionDef
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


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


def parse(file: str) -> ast.Module:
    return ast.parse((ROOT / file).read_text("utf-8"), file)


def functions(tree: ast.AST) -> list[Function]:
    return [node for node in ast.walk(tree) if isinstance(node, FUNCTIONS)]


def n_parameters(function: Function, method: bool) -> int:
    """Parameters of a function, without the instance or the class of a method."""
    given = function.args
    n = len(given.posonlyargs) + len(given.args) + len(given.kwonlyargs)
    n += (given.vararg is not None) + (given.kwarg is not None)
    static = "staticmethod" in map(ast.unparse, function.decorator_list)
    return n - (method and not static)


def breaches(file: str) -> list[str]:
    """What in a source file is beyond the limits for functions."""
    tree = parse(file)
    # The parameters of a command are what a user may write after it.
    most = MAX_OPTIONS if "/commands/" in file else MAX_PARAMETERS
    methods = {id(item) for c in ast.walk(tree) if isinstance(c, ast.ClassDef) for item in c.body}
    found = []
    for function in functions(tree):
        assert function.end_lineno is not None
        for what, value, limit in (
            ("lines", function.end_lineno - function.lineno + 1, MAX_FUNCTION_LINES),
            ("parameters", n_parameters(function, id(function) in methods), most),
        ):
            if value > limit:
                found.append(f"{file}:{function.lineno} {function.name}: {value} {what}")
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


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").exists()


def private_names(file: str) -> list[str]:
    """Private names of our own modules that a file imports, or takes from a module it imports."""
    tree, found = parse(file), []
    modules: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported = {alias.name: alias.asname or alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            imported = {f"{node.module}.{a.name}": a.asname or a.name for a in node.names}
        else:
            continue
        ours = {name: local for name, local in imported.items() if name.split(".")[0] in PACKAGES}
        modules |= {local for name, local in ours.items() if is_module(name)}
        found += [f"{file}:{node.lineno} {n}" for n in ours if any(map(is_private, n.split(".")))]
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            name = ast.unparse(node)
            found += [f"{file}:{node.lineno} {name}"] * (name.rpartition(".")[0] in modules)
    return found


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def test_tests_use_no_private_names_of_ours() -> None:
    report(name for file in tracked("tests") for name in private_names(file))
