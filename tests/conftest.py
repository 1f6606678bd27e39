"""What tests need that is not in the repository, and what many of them share."""

import os
from collections.abc import Iterator
from pathlib import Path

import drives
import pytest
from needs import lacking


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Decoded scans go to a folder of the tests', and not to the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ADAPTUNE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session")
def recorded() -> Path:
    """Folder of recorded sequences."""
    folder = os.environ.get("ADAPTUNE_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        lacking("data", "ADAPTUNE_TEST_DATA does not name the folder of recorded sequences")
        raise AssertionError
    return Path(folder)


@pytest.fixture(scope="session")
def study_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of three short drives, with its bags; not to be changed."""
    return drives.write_study(tmp_path_factory.mktemp("study"))
