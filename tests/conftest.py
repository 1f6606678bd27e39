"""What tests need that is not in the repository, and what many of them share."""

import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import drives
import pytest
from needs import lacking

from offline.config import load_study
from offline.train import train

Factory = pytest.TempPathFactory

SLOW = [
    "offline/test_kill.py",
    "offline/test_left_out.py",
    "adaptune/odometry/test_conformance.py",
    "offline/test_cluster.py",
    "online/test_comparison.py",
    "online/test_compared_modes.py",
    "adaptune/commands/test_cli.py",
    "offline/test_campaign.py",
    "adaptune/odometry/test_conformance_isolated.py",
    "adaptune/odometry/test_gicp.py",
    "offline/test_full.py",
    "adaptune/odometry/docker/test_played_bag.py",
    "adaptune/odometry/docker/test_lockstep.py",
    "adaptune/odometry/docker/test_docker_command.py",
    "adaptune/odometry/docker/test_docker_process.py",
    "adaptune/odometry/docker/test_engine.py",
    "adaptune/odometry/test_protocol.py",
    "adaptune/recording/test_survey.py",
    "adaptune/recording/test_inspect.py",
    "offline/test_resume.py",
    "adaptune/odometry/test_command.py",
    "offline/test_objective.py",
    "test_reference_image.py",
    "adaptune/simulation/test_recording.py",
    "offline/test_search.py",
    "online/test_stale_replays.py",
    "adaptune/test_inputs.py",
    "offline/test_baseline.py",
    "adaptune/odometry/test_frame_check.py",
    "offline/test_samplers.py",
    "test_readme.py",
    "test_benchmarks.py",
    "offline/test_budget.py",
    "offline/test_oracle.py",
    "adaptune/simulation/test_scenes.py",
    "offline/test_pruning.py",
    "adaptune/simulation/test_simulate.py",
    "offline/test_trial.py",
    "adaptune/test_selector.py",
    "adaptune/model/test_knn.py",
    "online/test_untrained.py",
    "offline/test_estimated_training.py",
    "online/test_estimated_replays.py",
    "offline/test_storage.py",
    "adaptune/reference/test_estimate.py",
    "adaptune/test_hosting.py",
    "offline/test_hosted_sampler.py",
    "adaptune/odometry/test_isolation.py",
    "adaptune/odometry/test_process.py",
    "adaptune/reference/test_registering.py",
    "adaptune/reference/test_consensus.py",
    "offline/test_progress.py",
    "online/test_recordings.py",
    "adaptune/test_interrupt.py",
    "adaptune/report/test_page.py",
    "adaptune/reference/test_picture.py",
    "adaptune/test_mistakes.py",
    "offline/test_tuning.py",
]
"""Files that take more than a few seconds, the longest first; `make quick` leaves them out."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the longest files first, so that all processes end at about the same time."""
    tests = Path(__file__).parent
    place = {tests / name: i for i, name in enumerate(SLOW)}
    if missing := [str(path) for path in place if not path.exists()]:
        raise pytest.UsageError(f"{__file__}: SLOW lists {', '.join(missing)}")
    items.sort(key=lambda item: place.get(item.path, len(place)))
    for item in items:
        if item.path in place:
            item.add_marker("slow")


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory: Factory) -> Iterator[None]:
    """Keep decoded scans in a folder of the tests, not in the user's cache."""
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


def shared(factory: Factory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder that the first process that needs it makes, and that all processes use."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    with folder.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        made = folder.with_suffix(".made")
        if not made.exists():
            make(folder)
            made.touch()
    return folder


@pytest.fixture(scope="session")
def study_file(tmp_path_factory: Factory) -> Path:
    """A study of three short drives, with its bags; not to be changed."""
    return shared(tmp_path_factory, "study", drives.write_study) / drives.STUDY_FILE


@pytest.fixture(scope="session")
def trained_folder(study_file: Path, tmp_path_factory: Factory) -> Path:
    """The run folder of the trained study; not to be changed."""

    def make(folder: Path) -> None:
        train(load_study(study_file, [], folder))

    return shared(tmp_path_factory, "trained", make)
