"""Trials whose errors are made up: in a study's archive, in a table, and of a pool of workers.

The error of a set on a sequence is told by a function of both.
"""

from dataclasses import replace

import numpy as np
from random_models import SPACE
from rooms import along_x

from adaptune.odometry.tracker import RegisteredScan
from adaptune.runs.archive import Archive, Frames, Trial, TrialSummary
from adaptune.runs.record import Run
from offline.config import OfflineConfig
from offline.trial_table import trial_table

N_FRAMES = 40


def made_trial(parameters, error):
    nothing, poses = np.zeros(N_FRAMES, bool), np.tile(np.eye(4), (N_FRAMES, 1, 1))
    return Trial.of(parameters, poses, np.full(N_FRAMES, error), nothing, 1.0)


def made_sets(n, space):
    """The baseline and random sets."""
    return [space.baseline, *space.from_unit(np.random.default_rng(0).random((n - 1, len(space))))]


def made_table(error, n=40, fixed=None):
    """A table of trials on two sequences."""
    sets = made_sets(n, SPACE)
    finished = {
        name: {
            i: TrialSummary(
                p, error(name, p), 0, 0, 1.0, {"register_ms": 1.0 + i, "prepare_ms": 1.0}
            )
            for i, p in enumerate(sets)
        }
        for name in ("one", "two")
    }
    return trial_table(OfflineConfig(), SPACE, finished, None if fixed is None else sets[fixed])


def write_trials(study, error, n, **changed):
    """Fill a study's archive, with the same sets on all training sequences."""
    archive = Archive(study.folder / "trials")
    for name in study.training:
        for number, parameters in enumerate(made_sets(n, study.odometry.space)):
            trial = replace(made_trial(parameters, error(name, parameters)), **changed)
            archive.write(name, number, trial)


class Drawn:
    """A pool of one worker, which takes no time."""

    def __init__(self, error):
        self.error = error
        self.tasks = []
        self._task = None

    def workers(self):
        return [0]

    def start(self, _worker, task):
        self.tasks.append(task)
        self._task = task

    def wait(self):
        task, self._task = self._task, None
        if task.segment is not None:
            return [(0, {n: [self._drive(task, one)] for n, one in task.sets.items()})]
        frames = Frames(
            np.arange(N_FRAMES) * 10**8,
            along_x(0.3 * np.arange(N_FRAMES)),
            np.random.default_rng(len(task.sequence)).random((N_FRAMES, 90)).astype(np.float32),
            {"ndt": 90},
            np.zeros(N_FRAMES, np.float32),
            evidence_ms=np.nan if task.frames is None else 1.0,
        )
        return [(0, frames)]

    def _drive(self, task, parameters):
        """A run that is too long by the error."""
        factor = 1.0 + 0.01 * self.error(task.sequence, parameters)
        return run_along(task.segment.stamps, 0.3 * factor)


def run_along(stamps, step, seconds=1e-3):
    """A run along x, with so many metres and seconds a scan."""
    poses = along_x(step * np.arange(len(stamps)))
    each = zip(stamps.tolist(), poses, strict=True)
    return Run(steps=[RegisteredScan(at, T, True, None, 0.0, seconds) for at, T in each])
