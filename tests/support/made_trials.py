"""Trials whose errors are made up, as a study's archive holds them and as a table."""

import numpy as np

from adaptune.archive import Archive, Summary, Trial
from adaptune.space import Categorical, Float, Integer, ParameterSpace
from offline.charts import trial_table
from offline.config import OfflineConfig

SPACE = ParameterSpace(
    {
        "distance": Float(low=1.0, high=10.0, baseline=4.0, log=True),
        "points": Integer(low=1, high=50, baseline=20),
        "kernel": Categorical(choices=("none", "huber"), baseline="none"),
    }
)


def made_sets(n, space=SPACE, seed=0):
    """The baseline and random sets."""
    drawn = space.from_unit(np.random.default_rng(seed).random((n - 1, len(space))))
    return [space.baseline, *drawn]


def made_table(error, n=40, names=("one", "two"), space=SPACE, fixed=None):
    """A table of trials whose error on a sequence is told by a function of name and set."""
    sets = made_sets(n, space)
    finished = {
        name: {
            i: Summary(p, error(name, p), 0, 0, 1.0, {"register_ms": 1.0 + i, "prepare_ms": 1.0})
            for i, p in enumerate(sets)
        }
        for name in names
    }
    return trial_table(OfflineConfig(), space, finished, None if fixed is None else sets[fixed])


def write_trials(study, error, n):
    """Fill a study's archive, with the same sets on all training sequences."""
    archive, frames = Archive(study.folder / "trials"), 4
    nothing = np.zeros(frames, bool)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for name in study.training:
        for number, parameters in enumerate(made_sets(n, study.odometry.space)):
            errors = np.full(frames, error(name, parameters))
            seconds = np.full(frames, 1e-3)
            trial = Trial(parameters, poses, errors, nothing, ~nothing, seconds)
            archive.write(name, number, trial)
