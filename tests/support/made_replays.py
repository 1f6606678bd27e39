"""Replays that are made up, as charts need them."""

import numpy as np

from adaptune.odometry.tracker import RegisteredScan
from adaptune.report.charts import Spans
from adaptune.runs.record import Choice, Run
from adaptune.space import Categorical, Float, ParameterSpace, Selection
from online.modes import Replays
from online.replayed import JudgedRun, ReplayedSequence

SECONDS = np.arange(0.0, 20.0, 0.1)
XY = np.column_stack([SECONDS, np.sin(SECONDS)])
SCENES = Spans([0.0, 8.0, 20.0], ("cave", "open"))


def replay(
    choices=None, states=None, estimated=None, restarted=(), seconds=(0.0, 8.0, 9.0), **errors
):
    """A replay of 20 s that changes its parameters twice."""
    choices = choices or {"distance": [0.7, 0.9, 0.9], "kernel": ["none", "none", "huber"]}
    states = ["good"] * len(seconds) if states is None else states
    estimated = np.full((len(seconds), 3), np.nan) if estimated is None else estimated
    made = []
    for i, second in enumerate(seconds):
        values = {name: of[i] for name, of in choices.items() if of[i] not in ("", None)}
        error, low, high = estimated[i]
        known = {"estimated_error": error, "estimated_low": low, "estimated_high": high}
        selection = Selection(0, values, state=states[i], **known)
        made.append(Choice(round(1e9 * second), selection, 0.0))
    steps = [
        RegisteredScan(stamp, np.eye(4), True, "max_speed" if i in restarted else None, 0.0, 0.0)
        for i, stamp in enumerate(np.round(1e9 * SECONDS).astype(np.int64).tolist())
    ]
    known = {
        "errors": np.where(SECONDS < 15.0, 0.7 + 0.1 * np.sin(SECONDS), np.nan),
        "errors_around": np.where(SECONDS < 16.0, 0.7, np.nan),
        "errors_behind": np.full(len(SECONDS), np.nan),
        "places": XY,
        "weights": {},
        "members": {},
    }
    return JudgedRun(Run(steps=steps, choices=made), **known | errors)


def kept():
    """A replay that keeps its parameters."""
    return replay({"distance": [0.7], "kernel": ["none"]}, seconds=[0.0])


def bank(**changed):
    """A replay of a bank."""
    weights = {"trial 4": [0.5, 0.2, 0.6], "trial 17": [0.3, 0.7, 0.1], "trial 2": [0.2, 0.1, 0.3]}
    states = {name: ["works"] * len(SECONDS) for name in weights}
    return replay(weights=weights, **{"members": states, **changed})


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
