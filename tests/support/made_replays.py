"""Replays that are made up, as charts need them."""

import numpy as np

from adaptune.report.charts import Spans
from adaptune.space import Categorical, Float, ParameterSpace
from online.modes import Replays
from online.replayed import ModeReplay, ReplayedSequence

SECONDS = np.arange(0.0, 20.0, 0.1)
XY = np.column_stack([SECONDS, np.sin(SECONDS)])
SCENES = Spans([0.0, 8.0, 20.0], ("cave", "open"))


def replay(**changed):
    """A replay of 20 s that changes its parameters twice."""
    made = ModeReplay(
        seconds=SECONDS,
        errors=np.where(SECONDS < 15.0, 0.7 + 0.1 * np.sin(SECONDS), np.nan),
        errors_around=np.where(SECONDS < 16.0, 0.7, np.nan),
        errors_behind=np.full(len(SECONDS), np.nan),
        restarted=np.zeros(len(SECONDS), bool),
        choice_seconds=np.array([0.0, 8.0, 9.0]),
        choices={"distance": [0.7, 0.9, 0.9], "kernel": ["none", "none", "huber"]},
        weights={},
        estimated=np.full((3, 3), np.nan),
        states=np.full(3, "good"),
        places=XY,
    )
    return made._replace(**changed)


def kept():
    """A replay that keeps its parameters."""
    fixed = {"distance": [0.7], "kernel": ["none"]}
    one = {"choice_seconds": np.zeros(1), "choices": fixed, "states": np.full(1, "good")}
    return replay(**one, estimated=np.full((1, 3), np.nan))


def bank(**changed):
    """A replay of a bank."""
    weights = {"trial 4": [0.5, 0.2, 0.6], "trial 17": [0.3, 0.7, 0.1], "trial 2": [0.2, 0.1, 0.3]}
    return replay(weights=weights, **changed)


SPACE = ParameterSpace.of(
    odometry=Categorical(choices=("gicp", "ndt"), baseline="gicp"),
    distance=Float(low=0.1, high=2.0, baseline=1.0, log=True, unit="m"),
    kernel=Categorical(choices=("none", "huber"), baseline="none"),
    resolution=Float(low=0.5, high=4.0, baseline=1.0, log=True, unit="m"),
)


def sequence(**modes):
    """The replays of a sequence by mode."""
    return ReplayedSequence("new", 10.0, modes, SPACE, SCENES)


def folder_of(study, mode, name="three"):
    """Where a replay of a study is, with its own error model."""
    return Replays.of(study).folder(name, mode)
