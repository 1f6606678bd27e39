"""Replay a recording in lockstep, selecting parameters on the way."""

import csv
import json
import logging
import time
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from adaptune import selection as applied
from adaptune.descriptor import Describer, DescriptorError, lowest_elevation
from adaptune.descriptor.motion import MOTION, SECOND, fill_in, speed_and_turn_rate
from adaptune.errors import AdaptuneError
from adaptune.files import replacing, write_text
from adaptune.geometry import Poses, invert
from adaptune.model import RULES, ErrorModel, PairedFusion, Selection
from adaptune.model.fusion import Steady
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.health import Guard, HealthCheck
from adaptune.sequence import Scan
from adaptune.space import ParameterSet
from adaptune.trajectory import Trajectory, write_tum

_log = logging.getLogger(__name__)

SCANS_TO_KNOW = 10
"""A sensor by: the median of so many scans that selections are made from."""

STILL = np.zeros(2)


class Policy(Protocol):
    """Chooses a parameter set."""

    def __call__(self, scan: Scan, motion: NDArray[np.float64] | None = None, /) -> Selection:
        """For a scan, and for speed and turn rate before it, of shape (2,), if it asks for them."""
        ...


class Choice(NamedTuple):
    """A selection that was made.

    Attributes
    ----------
    stamp : int
        Nanoseconds, of the scan it was made from and first applied to.
    selection : Selection
    parameters : dict
    seconds : float
        What describing the scan and choosing took.
    """

    stamp: int
    selection: Selection
    parameters: ParameterSet
    seconds: float


@dataclass(frozen=True, eq=False)
class Replay:
    """One way through a recording.

    Attributes
    ----------
    trajectory : Trajectory
        The odometry's.
    restarted : ndarray of shape (n,)
        Frames at which the health check started the odometry anew.
    registered : ndarray of shape (n,)
        False where the scan was too poor to register and the last motion went on.
    prepare_seconds, register_seconds : ndarray of shape (n,)
    choices : list of Choice
    seconds : float
        The whole replay, reading included.
    unhealthy : dict
        What the health check said, and how often.
    """

    trajectory: Trajectory
    restarted: NDArray[np.bool_]
    registered: NDArray[np.bool_]
    prepare_seconds: NDArray[np.float64]
    register_seconds: NDArray[np.float64]
    choices: list[Choice]
    seconds: float
    unhealthy: dict[str, int]


def adaptive(
    model: ErrorModel, rule: str, price: float = 0.0, members: list[int] | None = None
) -> Policy:
    """A policy that asks an error model.

    By the paired rule, scans of a sensor or mount that was not trained with, see
    `ErrorModel.is_foreign`, get the fixed set.

    Parameters
    ----------
    model
        Fitted offline.
    rule
        One of `adaptune.model.RULES`.
    price
        What a switch must promise, as a share of the fixed set's error.
    members
        The sets in a bank, the first of which counts as the fixed one: the paired rule weighs
        them, others choose among them. All sets, and the model's fixed one, when left out.
    """
    pca = model.pca()
    data = model.training_data(pca, members)
    fused = members is not None and rule == "paired"
    fitted = (
        PairedFusion(model.fusion).fit(data)
        if fused
        else RULES[rule](model.paired, price).fit(data)
    )
    describe = Describer(model.blocks)
    if describe.blocks != model.blocks:
        raise DescriptorError(
            f"the model was fitted to descriptors of {model.blocks} numbers, these have "
            f"{describe.blocks}; run `adaptune offline` again"
        )
    foreign = _foreign(model)
    last: deque[NDArray[np.float32]] = deque(maxlen=model.window)
    steadied = Steady()
    current: int | None = None

    def select(scan: Scan, motion: NDArray[np.float64] | None = None, /) -> Selection:
        nonlocal current
        described = describe(scan)
        if motion is not None:
            fill_in(described, describe.blocks, motion)
        elif MOTION in describe.blocks:
            raise DescriptorError(
                f"the model knows places by `{MOTION}`, too: tell speed and turn rate with the scan"
            )
        last.append(described)
        mean = np.stack(last).mean(axis=0, dtype=np.float64, keepdims=True)
        selection = fitted.select(pca.transform(mean.astype(np.float32))[0], current)
        if selection.weights is not None and members is not None:
            selection = steadied(selection, members)
        if fitted.gated and foreign(scan):
            fixed = selection.predicted_fixed
            weights = tuple(float(i == data.fixed) for i in members or ()) if fused else None
            selection = Selection(data.fixed, fixed, fixed, 0.0, weights=weights)
        current = selection.set_index
        return selection

    # The first call loads compiled code; the robot should not wait for that.
    select(Scan(0, np.zeros((0, 3), np.float32)), STILL)
    last.clear()
    steadied = Steady()
    current = None
    return select


def _foreign(model: ErrorModel) -> Callable[[Scan], bool]:
    """Tells, scan after scan, whether they come from a sensor that was not trained with."""
    seen: list[float] = []
    told = False

    def foreign(scan: Scan) -> bool:
        nonlocal told
        if len(scan) and len(seen) < SCANS_TO_KNOW:
            seen.append(lowest_elevation(scan))
        if not seen or not model.is_foreign(lowest := float(np.median(seen))):
            return False
        if not told:
            known = sorted({f"{elevation:.0f}" for elevation in model.elevations})
            _log.warning(
                "the scans' lowest points lie at %.0f degrees, those of training at %s: this is "
                "another sensor or mount; the fixed set is kept",
                lowest,
                ", ".join(known),
            )
        told = True
        return True

    return foreign


def replay(
    scans: Iterable[Scan],
    odometry: OdometryInstance,
    health: HealthCheck,
    policy: Policy | None = None,
    sets: list[ParameterSet] | None = None,
    period: float = 1.0,
    progress: Callable[[], None] = lambda: None,
    members: list[int] | None = None,
) -> Replay:
    """Drive an odometry through a recording, as fast as it goes and always the same way.

    A selection is made at the first scan and then at the first scan of every further period, from
    that scan and before it is registered.

    Parameters
    ----------
    scans
        In order of time.
    odometry
        A new instance; if there is a policy, one that can change its parameters between scans, by
        itself, by a hand-over or in a bank.
    health
        The odometry is started anew where its motion is not healthy.
    policy
        Chooses the parameters; none leaves them as they are.
    sets
        The parameter sets that the policy chooses among.
    period
        Seconds between selections.
    progress
        Called after every scan.
    members
        Of a bank, the sets that the weights of a selection belong to.

    Raises
    ------
    AdaptuneError
        If there are no scans.
    OdometryError
        If the odometry cannot change its parameters.
    """
    begin = time.perf_counter()
    stamps: list[int] = []
    poses: list[Poses] = []
    restarted: list[bool] = []
    registered: list[bool] = []
    timings: list[tuple[float, float]] = []
    choices: list[Choice] = []
    guard, unhealthy = Guard(health), Counter[str]()
    n_periods = 0
    for scan in scans:
        first = stamps[0] if stamps else scan.stamp
        if (
            policy is not None
            and sets is not None
            and (scan.stamp - first >= n_periods * period * 1e9)
        ):
            t = time.perf_counter()
            selection = policy(scan, _motion(stamps, poses))
            parameters = sets[selection.set_index]
            seconds = time.perf_counter() - t
            weights = None
            if selection.weights is not None:
                weights = dict(zip(members or (), selection.weights, strict=True))
            odometry.apply(applied.Selection(selection.set_index, parameters, weights))
            choices.append(Choice(scan.stamp, selection, parameters, seconds))
            n_periods = int((scan.stamp - first) // (period * 1e9)) + 1
        t_prepare = time.perf_counter()
        prepared = odometry.prepare(scan)
        t_register = time.perf_counter()
        if not stamps:
            T_odom_sensor = np.eye(4)
            odometry.start(prepared, T_odom_sensor)
            registered.append(True)
            restarted.append(False)
        else:
            T_odom_sensor, ok = odometry.register(prepared)
            elapsed = (scan.stamp - stamps[-1]) * 1e-9
            what = guard.check(invert(poses[-1]) @ T_odom_sensor, elapsed, ok)
            restarted.append(what is not None)
            registered.append(ok)
            if what is not None:
                unhealthy[what] += 1
                T_healthy = guard.go_on(elapsed)
                T_odom_sensor = poses[-1] @ T_healthy
                odometry.start(prepared, T_odom_sensor, T_healthy)
        timings.append((t_register - t_prepare, time.perf_counter() - t_register))
        stamps.append(scan.stamp)
        poses.append(T_odom_sensor)
        progress()
    if not stamps:
        raise AdaptuneError("there is no scan to replay")
    prepare_seconds, register_seconds = np.array(timings).T
    return Replay(
        Trajectory(np.array(stamps, np.int64), np.array(poses)),
        np.array(restarted),
        np.array(registered),
        prepare_seconds,
        register_seconds,
        choices,
        time.perf_counter() - begin,
        dict(unhealthy),
    )


def _motion(stamps: list[int], poses: list[Poses]) -> NDArray[np.float64]:
    """Speed and turn rate at the last pose, of shape (2,)."""
    if not stamps:
        return STILL
    begin = max(bisect_right(stamps, stamps[-1] - SECOND) - 1, 0)
    recent = np.array(stamps[begin:], np.int64), np.array(poses[begin:])
    return np.asarray(speed_and_turn_rate(*recent)[-1])


def write_replay(folder: Path, result: Replay, about: dict[str, object]) -> None:
    """Write ``trajectory.tum``, ``selections.csv``, ``frames.csv`` and, last, ``replay.json``.

    Parameters
    ----------
    folder
        Where to.
    result
        The replay.
    about
        What it was made from; kept in ``replay.json``.
    """
    write_tum(folder / "trajectory.tum", result.trajectory)
    names = list(result.choices[0].parameters) if result.choices else []
    with (
        replacing(folder / "selections.csv") as beside,
        beside.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        columns = "stamp_ns set predicted_error_percent predicted_fixed_percent"
        writer.writerow([*columns.split(), "familiarity", "sequences", "weights", "ms", *names])
        for choice in result.choices:
            index, *numbers, weights = choice.selection
            writer.writerow(
                [choice.stamp, index, *(f"{x:.4f}" for x in numbers)]
                + [" ".join(f"{weight:.3f}" for weight in weights or ())]
                + [f"{1e3 * choice.seconds:.3f}"]
                + [choice.parameters[name] for name in names]
            )
    with (
        replacing(folder / "frames.csv") as beside,
        beside.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(["stamp_ns", "registered", "restarted", "prepare_ms", "register_ms"])
        writer.writerows(
            zip(
                result.trajectory.stamps.tolist(),
                result.registered.astype(int).tolist(),
                result.restarted.astype(int).tolist(),
                np.round(1e3 * result.prepare_seconds, 3).tolist(),
                np.round(1e3 * result.register_seconds, 3).tolist(),
                strict=True,
            )
        )
    duration = float(result.trajectory.stamps[-1] - result.trajectory.stamps[0]) * 1e-9
    summary = {
        "scans": len(result.trajectory),
        "duration_s": round(duration, 3),
        "replay_s": round(result.seconds, 3),
        "restarts": int(result.restarted.sum()),
        "unhealthy": result.unhealthy,
        "poor_scans": int((~result.registered).sum()),
        "selections": len(result.choices),
        "about": about,
    }
    write_text(folder / "replay.json", json.dumps(summary, indent=2) + "\n")
