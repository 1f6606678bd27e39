"""What tests need that is not in the repository."""

import importlib.util
import os
import shutil

import pytest


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
