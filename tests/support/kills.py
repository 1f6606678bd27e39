"""Campaigns whose processes are killed at random moments, and what must be left of them."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from wicked import children

from adaptune.model import ErrorModel
from adaptune.runs.archive import Archive

PAUSE = 0.5
"""Seconds; about what a driver takes to start, or to end after its last trial."""


def contents(folder: Path) -> dict[Path, object]:
    """All that must not depend on who ran a campaign, when, and how often it was stopped."""
    found: dict[Path, object] = {}
    for path in sorted((folder / "trials").rglob("*.npz")):
        with np.load(path) as data:
            found[path.relative_to(folder)] = {
                key: data[key].tobytes()
                for key in data
                if key not in ("seconds", "usage", "summary", "evidence_ms")
            }
    # What is chosen follows from what sets cost, too, which no two campaigns measure alike.
    model = ErrorModel.load(folder / "model.safetensors")
    errors = model.errors.tobytes(), model.descriptors.tobytes()
    found[Path("model.safetensors")] = model.sets.trials, model.sets.parameters, errors
    return found


def begin(study_file: Path, folder: Path, *overrides: str) -> subprocess.Popen[str]:
    """Start a campaign in a process of its own."""
    given = [word for text in overrides for word in ("-o", text)]
    command = [sys.executable, "-m", "adaptune.commands.cli", "offline", str(study_file)]
    return subprocess.Popen(
        [*command, "--folder", str(folder), *given],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def workers(driver: int) -> list[int]:
    """Process numbers of a driver's workers: what its fork server has forked."""
    return [worker for server in children(driver) for worker in children(server)]


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
    n_files: int,
    rng: np.random.Generator,
    *overrides: str,
) -> tuple[int, int]:
    """Run a campaign to its end, killing its driver or one of its workers at random moments.

    Moments are counted in trials and not in seconds, so that as many kills land on a machine that
    is busy: each comes up to `PAUSE` after up to a fifth of all trials (`n_files` in all) were
    finished since the last one, be it while the driver starts or while the model is fitted.
    Returns how many drivers and workers were killed.
    """
    killed, finished = [0, 0], {}
    while True:
        driver = begin(study_file, folder, *overrides)
        while sum(killed) < kills and driver.poll() is None:
            n = min(len(files(folder)) + int(rng.integers(n_files // 5 + 1)), n_files)
            while len(files(folder)) < n and driver.poll() is None:
                time.sleep(0.05)
            time.sleep(float(rng.uniform(0.0, PAUSE)))
            of_workers = bool(rng.random() < 0.5)
            pool = workers(driver.pid) if of_workers else [driver.pid]
            if pool and driver.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(rng.choice(pool)), signal.SIGKILL)
                    killed[of_workers] += 1
                if not of_workers:
                    break
        _, said = driver.communicate()
        now = files(folder)
        assert now.items() >= finished.items(), "a finished trial was lost or run again"
        finished = now
        if driver.returncode == 0:
            return killed[0], killed[1]
        # By chance, several workers may have been killed at the same trials.
        assert driver.returncode == -signal.SIGKILL or "workers died" in said, said


def check_once(folder: Path, n_trials: int, sequences: list[str]) -> None:
    """Make sure that every trial is there."""
    archive = Archive(folder / "trials")
    for name in sequences:
        assert list(archive.finished(name)) == list(range(n_trials))
