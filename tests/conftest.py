"""What tests need that is not in the repository, and fixtures for all of them."""

import os
from pathlib import Path

import pytest


def lacking(name: str, reason: str) -> None:
    """Skip for want of `name`; fail if ADAPTUNE_REQUIRE names it (comma-separated)."""
    if name in os.environ.get("ADAPTUNE_REQUIRE", "").split(","):
        pytest.fail(f"ADAPTUNE_REQUIRE names {name}, but {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="session")
def recorded() -> Path:
    """Folder of recorded sequences."""
    folder = os.environ.get("ADAPTUNE_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        lacking("data", "ADAPTUNE_TEST_DATA does not name the folder of recorded sequences")
        raise AssertionError
    return Path(folder)
