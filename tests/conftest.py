"""What tests need that is not in the repository, and what many of them share."""

import os
from collections.abc import Iterator
from pathlib import Path

import drives
import pytest
from needs import lacking

STUDY = """\
odometry:
  name: gicp
  settings: {downsampling: 0.5, min_range: 0.5}
  parameters:
    max_correspondence_distance: {low: 0.1, high: 5.0, baseline: 2.0, log: true}
    keyframe_interval: {low: 0.5, high: 15.0, baseline: 1.0, log: true}
sequences:
  one: {bag: one.bag, points: /points, reference: /truth}
  two: {bag: two.bag, points: /points, reference: /truth}
  three: {bag: three.bag, points: /points, reference: /truth}
training: [one, two]
test: [three]
sub_trajectory: 3.0
offline: {trials: 10, initial: 4, batch: 4, seed: 3, workers: 2}
"""


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
    folder = tmp_path_factory.mktemp("study")
    for seed, name in enumerate(("one", "two", "three")):
        drives.write_bag(folder / f"{name}.bag", drives.scans(seed, 40))
    (folder / "small.yaml").write_text(STUDY)
    return folder / "small.yaml"
