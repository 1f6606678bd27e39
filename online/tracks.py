"""From stored replays to what is drawn of them."""

import numpy as np
from numpy.typing import NDArray

from adaptune.geometry import invert
from adaptune.model import ErrorModel
from adaptune.study.driven import named
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory
from online.modes import UNTRAINED
from online.replay_picture import Track
from online.statistics import Reference
from online.stored_replays import StoredReplay


def reference_of(study: Study, name: str) -> Reference:
    """What judges the replays of a sequence.

    An estimated one is computed with odometries of its own, never with the members of a bank.
    """
    folder, stored = study.folder / "replays" / name, study.sequences.estimate(name)
    return Reference.read(folder, study.config.sub_trajectory, stored)


def track_of(replay: StoredReplay, reference: Reference, model: ErrorModel | None) -> Track:
    """What is drawn of a replay.

    Parameters
    ----------
    replay
        The replay.
    reference
        Of the sequence.
    model
        What the replay is of, to name the members of a bank; None if it is not there any more.
    """
    stamps, known = replay.trajectory.stamps, reference.trajectory
    # The odometry's own frame begins elsewhere: both are drawn from the first common pose.
    start = 0 if known is None else int(np.argmax(np.isin(stamps, known.stamps)))
    return Track(
        (stamps - stamps[0]) * 1e-9,
        seen_from(replay.trajectory, start),
        reference.errors(replay.trajectory),
        reference.errors_behind(replay.trajectory),
        replay.restarted,
        np.asarray((replay.choice_stamps - stamps[0]) * 1e-9),
        replay.choices,
        {member_of(replay, model, number): of for number, of in replay.weights.items()},
        replay.estimated,
        replay.lost,
    )


def member_of(replay: StoredReplay, model: ErrorModel | None, number: int) -> str:
    """What a member of a bank is called. Those of a bank without a model are no trials."""
    if replay.summary.about.mode == UNTRAINED:
        return f"untrained set {number}" if number else "baseline's set"
    if model is None or number not in model.sets:
        return f"trial {number}"
    return f"trial {named(model, number)}"


def seen_from(trajectory: Trajectory, start: int = 0) -> NDArray[np.float64]:
    """Positions in the plane of the sensor at a pose: x forward, y to the left."""
    T = trajectory.T_world_sensor
    return np.asarray((invert(T[start]) @ T)[:, :2, 3])
