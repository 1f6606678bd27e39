"""What tests need that is not in the repository, and what many of them share."""

import fcntl
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import drives
import fake_odometry
import hypothesis
import pytest
from needs import lacking

from adaptune.odometry.registry import ODOMETRIES
from offline import train as training
from offline.config import load_study
from offline.train import train
from offline.workers import Bench, TaskProgress, Workers, attempt

hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")

Factory = pytest.TempPathFactory
SUPPORT = Path(__file__).parent / "support"


@pytest.fixture(scope="session")
def recorded() -> Path:
    """Folder of recorded sequences."""
    folder = os.environ.get("ADAPTUNE_TEST_DATA")
    if not folder or not Path(folder).is_dir():
        lacking("data", "ADAPTUNE_TEST_DATA does not name the folder of recorded sequences")
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


class InProcess:
    """Stands in for `Workers`: as many workers, one after another, when an outcome is asked for."""

    def __init__(self, setup, n, memory):
        self.setup, self.n, self.memory = setup, n, memory
        self._benches = [Bench(setup, memory / n) for _ in range(n)]
        self._tasks = {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def workers(self):
        return range(self.n)

    def start(self, worker, task):
        self._tasks[worker] = task

    def wait(self):
        worker, said = next(iter(self._tasks)), []
        outcome = attempt(
            self._benches[worker],
            self._tasks.pop(worker),
            lambda *now: said.append((worker, TaskProgress(*now))),
        )
        return [*said, (worker, outcome)]


@pytest.fixture(scope="session", autouse=True)
def _quick_and_apart(tmp_path_factory: Factory) -> Iterator[None]:
    """Run trials and the fake odometry in this process; leave the user's cache alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ADAPTUNE_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setitem(ODOMETRIES, fake_odometry.NAME, fake_odometry.NAME)
        # Commands in processes of their own find it, too.
        support = [str(SUPPORT), os.environ.get("PYTHONPATH", "")]
        patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, support)))
        # It takes no time to start; see `processes`.
        patch.setattr(training, "Workers", InProcess)
        yield


@pytest.fixture
def processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run trials in processes of their own, as adaptune does."""
    monkeypatch.setattr(training, "Workers", Workers)


@pytest.fixture(scope="session")
def study_file(tmp_path_factory: Factory) -> Path:
    """A study of three short drives with the fake odometry, and its bags; not to be changed."""
    return shared(tmp_path_factory, "study", drives.write_study) / drives.STUDY_FILE


@pytest.fixture(scope="session")
def trained_folder(study_file: Path, tmp_path_factory: Factory) -> Path:
    """The run folder of the trained study; not to be changed."""

    def make(folder: Path) -> None:
        train(load_study(study_file, [], folder))

    return shared(tmp_path_factory, "trained", make)
