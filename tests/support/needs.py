"""What tests need that is not in the repository."""

import fcntl
import importlib.util
import os
import shutil
import sys
from functools import cache, partial
from pathlib import Path
from typing import Any, NoReturn

import pytest

ROOT = Path(__file__).parents[2]


def lacking(name: str, reason: str) -> NoReturn:
    """Skip for want of `name`; fail if ADAPTUNE_REQUIRE names it (comma-separated)."""
    if name in os.environ.get("ADAPTUNE_REQUIRE", "").split(","):
        pytest.fail(f"ADAPTUNE_REQUIRE names {name}, but {reason}")
    pytest.skip(reason)


def needs(package: str, extra: str) -> None:
    """Skip where a package of an extra is not installed."""
    if importlib.util.find_spec(package) is None:
        lacking(extra, f"{package} is not installed: pip install 'adaptune[{extra}]'")


needs_evalio = partial(needs, "evalio", "evalio")


def needs_program(program: str, service: str) -> str:
    """The path of a program of a service; skip where there is none."""
    if (path := shutil.which(program)) is None:
        lacking(service, f"there is no {program}: make services")
    return path


@cache
def module_of(file: str) -> Any:
    """The module in a file of the repository, which lies in no package."""
    name = file.removesuffix(".py").replace("/", "_")
    spec = importlib.util.spec_from_file_location(name, ROOT / file)
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def reference_image(name: str = "reference", service: str = "docker") -> str:
    """Build a reference image, once in a run of pytest; skip where none can. Returns its tag."""
    builder = module_of("docker/build.py")
    lock = ROOT / f"build/docker-{name}.lock"
    lock.parent.mkdir(exist_ok=True)
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", "")
    with lock.open("a+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        held.seek(0)
        # Another process of this run may have built it.
        if run and held.read() == run:
            return str(builder.TAGS[name])
        try:
            tag: str = builder.build(name)
        except builder.LackingError as error:
            lacking(service, str(error))
        held.truncate(0)
        held.write(run)
    return tag


def ros2_image() -> str:
    """Build the image of the ROS 2 reference; skip where there is no Rust, no Docker, no DDS."""
    needs("cyclonedds", "ros2")
    return reference_image("reference-ros2", "ros2")
