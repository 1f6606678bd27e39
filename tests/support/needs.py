"""What tests need that is not in the repository."""

import fcntl
import importlib.util
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


def lacking(name: str, reason: str) -> None:
    """Skip for want of `name`; fail if ADAPTUNE_REQUIRE names it (comma-separated)."""
    if name in os.environ.get("ADAPTUNE_REQUIRE", "").split(","):
        pytest.fail(f"ADAPTUNE_REQUIRE names {name}, but {reason}")
    pytest.skip(reason)


def needs_evalio() -> None:
    """Skip where evalio is not installed."""
    if importlib.util.find_spec("evalio") is None:
        lacking("evalio", "evalio is not installed: pip install 'adaptune[evalio]'")


def needs_ros2() -> None:
    """Skip where what speaks to ROS 2 is not installed."""
    if importlib.util.find_spec("zenoh_ros2_sdk") is None:
        lacking("ros2", "zenoh-ros2-sdk is not installed: pip install 'adaptune[ros2]'")


def needs_ros1() -> None:
    """Skip where there is no ROS 1."""
    if shutil.which("roscore") is None:
        lacking("ros1", "there is no roscore: make services")


def needs_browser() -> str:
    """Skip where there is no Chromium, or nothing to drive it; otherwise its path."""
    if importlib.util.find_spec("playwright") is None:
        lacking("browser", "playwright is not installed: pip install 'adaptune[dev]'")
    chromium = shutil.which("chromium")
    if chromium is None:
        lacking("browser", "there is no chromium: make services")
        raise AssertionError
    return chromium


@cache
def image_builder() -> Any:
    """The module docker/build.py."""
    spec = importlib.util.spec_from_file_location("docker_build", ROOT / "docker/build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def needs_docker() -> None:
    """Skip where no Docker engine answers."""
    builder = image_builder()
    try:
        builder.engine().close()
    except builder.LackingError as error:
        lacking("docker", str(error))


@cache
def reference_image() -> str:
    """Build the reference image, once in a run of pytest, and return its tag."""
    needs_docker()
    builder = image_builder()
    lock = ROOT / "build/docker.lock"
    lock.parent.mkdir(exist_ok=True)
    run = os.environ.get("PYTEST_XDIST_TESTRUNUID", "")
    with lock.open("a+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        held.seek(0)
        # Another process of this run may have built it.
        if run and held.read() == run:
            return str(builder.TAGS["reference"])
        try:
            tag: str = builder.build("reference")
        except builder.LackingError as error:
            lacking("docker", str(error))
            raise
        held.truncate(0)
        held.write(run)
    return tag
