"""Campaigns whose processes are killed at random moments, and what must be left of them."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import optuna
from optuna.storages.journal import JournalFileBackend

from adaptune.archive import INDEX, Archive


def contents(folder: Path) -> dict[Path, object]:
    """All that must not depend on who ran a campaign, when, and how often it was stopped."""
    found: dict[Path, object] = {}
    for path in sorted((folder / "trials").rglob("*.npz")):
        with np.load(path) as data:
            found[path.relative_to(folder)] = {
                key: data[key].tobytes() for key in data if key not in ("seconds", "usage")
            }
    for name in ("model.npz", "fixed.yaml"):
        found[Path(name)] = (folder / name).read_bytes()
    return found


def begin(study_file: Path, folder: Path, *overrides: str) -> subprocess.Popen[str]:
    """Start a campaign in a process of its own."""
    given = [word for text in overrides for word in ("-o", text)]
    command = ["-m", "adaptune.cli", "offline", str(study_file), "--folder", str(folder), *given]
    return subprocess.Popen(
        [sys.executable, *command],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def workers(driver: int) -> list[int]:
    """Process numbers of a driver's workers: what its fork server has forked."""
    return [worker for server in _children(driver) for worker in _children(server)]


def _children(process: int) -> list[int]:
    try:
        return [
            int(n) for n in Path(f"/proc/{process}/task/{process}/children").read_text().split()
        ]
    except OSError:
        return []


def files(folder: Path) -> dict[Path, tuple[int, int]]:
    """The files of finished trials, and when they were written."""
    return {
        path: (path.stat().st_size, path.stat().st_mtime_ns)
        for path in (folder / "trials").glob("*/[0-9]*.npz")
    }


def disturb(
    study_file: Path,
    folder: Path,
    kills: int,
    longest: float,
    rng: np.random.Generator,
    *overrides: str,
) -> tuple[int, int]:
    """Run a campaign to its end, killing its driver or one of its workers at random moments.

    Parameters
    ----------
    study_file, folder
        The study.
    kills
        The most to kill.
    longest
        Seconds; each kill comes at a random moment of as many since the last one.
    rng
        Chooses.
    overrides
        Of the study's values.

    Returns
    -------
    n_drivers, n_workers : int
        How many were killed.
    """
    killed = [0, 0]
    finished: dict[Path, tuple[int, int]] = {}
    driver = begin(study_file, folder, *overrides)
    while True:
        if sum(killed) < kills:
            try:
                driver.wait(rng.uniform(0.0, longest))
            except subprocess.TimeoutExpired:
                pool = workers(driver.pid) if rng.random() < 0.5 else []
                os.kill(int(rng.choice(pool or [driver.pid])), signal.SIGKILL)
                killed[bool(pool)] += 1
                if pool:
                    continue
        _, said = driver.communicate()
        now = files(folder)
        assert now.items() >= finished.items(), "a finished trial was lost or run again"
        finished = now
        if driver.returncode == 0:
            return killed[0], killed[1]
        assert driver.returncode == -signal.SIGKILL, said
        driver = begin(study_file, folder, *overrides)


def check_once(folder: Path, n_trials: int, sequences: list[str]) -> None:
    """Make sure that every trial is there once: as a file, in the index, in Optuna's journal."""
    archive = Archive(folder / "trials")
    for name in sequences:
        assert list(archive.finished(name)) == list(range(n_trials))
    lines = (folder / "trials" / INDEX).read_text().splitlines()
    assert len(lines) == n_trials * len(sequences)
    storage = optuna.storages.JournalStorage(JournalFileBackend(str(folder / "optuna.log")))
    (name,) = optuna.get_all_study_names(storage)
    told = optuna.load_study(study_name=name, storage=storage)
    numbers = [t.user_attrs["adaptune trial"] for t in told.trials]
    assert numbers == list(range(n_trials))
