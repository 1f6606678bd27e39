"""What it costs to change parameters on the way, measured for a study's odometry."""

import itertools
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.geometry import Poses
from adaptune.metrics import sub_trajectory_rte
from adaptune.model import Selection
from adaptune.odometry import Bank, Box, HandOver, WarmUp
from adaptune.sequence import Scan
from adaptune.space import ParameterSet
from adaptune.study.study import Study
from online.replay import replay

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

WARM_UPS = (4.0, 8.0, 12.0)
"""Seconds, of which a new instance sees every scan."""

PERIOD = 5.0
"""Seconds between switches."""


def measure_switching(
    study: Study, seconds: float = 60.0, progress: Progress = lambda *_: None
) -> list[dict[str, Any]]:
    """Switch every 5 s to the same parameters, which ought to change nothing.

    Parameters
    ----------
    study
        The study; its folder receives ``switching.json``.
    seconds
        How much of every training sequence is used.
    progress
        Told about every scan.

    Returns
    -------
    list of dict
        A row for every mechanism and warm-up: geometric mean over the sequences of the RTE as a
        ratio to that without switching, and mean milliseconds a scan.

    Raises
    ------
    AdaptuneError
        If a sequence is too short, or its reference unknown.
    """
    study.open()
    ratios: dict[str, list[float]] = {}
    times: dict[str, list[float]] = {}
    for name in study.config.training:
        scans, T_ref_sensor = _read(study, name, seconds)
        alone = 0.0
        for what, make in _mechanisms(study).items():
            box, sets = make()
            error, ms = _drive(study, f"{name}, {what}", scans, T_ref_sensor, box, sets, progress)
            alone = alone or error
            ratios.setdefault(what, []).append(error / max(alone, 1e-12))
            times.setdefault(what, []).append(ms)
    means = {what: float(np.exp(np.mean(np.log(r)))) for what, r in ratios.items()}
    rows: list[dict[str, Any]] = [
        {"mechanism": what, "RTE ratio": mean, "ms a scan": float(np.mean(times[what]))}
        | dict(zip(study.config.training, ratios[what], strict=True))
        for what, mean in means.items()
    ]
    found = {
        "of": study.switching_identity(),
        "switch_cost": means[_own(study)] - 1.0,
        "seconds": seconds,
        "rows": rows,
    }
    write_text(study.folder / "switching.json", json.dumps(found, indent=2) + "\n")
    return rows


def _read(study: Study, name: str, seconds: float) -> tuple[list[Scan], Poses]:
    sequence = study.sequences.open(name)
    scans: list[Scan] = []
    for scan in sequence:
        if scans and (scan.stamp - scans[0].stamp) * 1e-9 > seconds:
            break
        scans.append(scan)
    reference = sequence.reference()
    if reference is None:
        raise AdaptuneError(f"sequences.{name}: has no reference to measure errors against")
    return scans, reference.at(np.array([scan.stamp for scan in scans], np.int64))


Driven = tuple[Box, list[ParameterSet] | None]
"""What is driven, and the sets that it changes between."""


def _mechanisms(study: Study) -> dict[str, Callable[[], Driven]]:
    """By name, what makes each mechanism that the odometry can have; the first never switches."""

    def same(_: ParameterSet) -> Box:
        return study.odometry()

    # Sets that differ in name only.
    names: list[ParameterSet] = [{"number": 0}, {"number": 1}]

    def hand_over(warm_up: WarmUp) -> Callable[[], Driven]:
        return lambda: (HandOver(same, names[0], warm_up, catch_up_scans), names)

    catch_up_scans = study.config.online.switching.catch_up_scans
    warm_ups = dict.fromkeys([*(WarmUp(s, s, 1) for s in WARM_UPS), study.warm_up])
    made: dict[str, Callable[[], Driven]] = {"none": lambda: (study.odometry(), None)}
    if study.odometry.description.live:
        made["live"] = lambda: (study.odometry(), _alike(study.odometry.space.baseline))
    made |= {_say(warm_up): hand_over(warm_up) for warm_up in warm_ups}
    made["bank"] = lambda: (Bank(same, names, study.warm_up), names)
    return made


def _alike(parameters: ParameterSet) -> list[ParameterSet]:
    """Two sets that differ so little that only the change itself tells."""
    nearly = {n: v * (1 + 1e-9) if isinstance(v, float) else v for n, v in parameters.items()}
    return [parameters, nearly]


def _say(warm_up: WarmUp) -> str:
    seconds, full_rate, stride = warm_up
    sparse = "" if stride == 1 or full_rate >= seconds else f", {full_rate:g} s in full"
    return f"hand_over, {seconds:g} s{sparse}"


def _own(study: Study) -> str:
    """Name of the mechanism that the study uses."""
    return _say(study.warm_up) if study.mechanism == "hand_over" else study.mechanism


def _drive(
    study: Study,
    what: str,
    scans: Sequence[Scan],
    T_ref_sensor: Poses,
    box: Box,
    sets: list[ParameterSet] | None,
    progress: Progress,
) -> tuple[float, float]:
    """Mean RTE in percent, and mean milliseconds a scan."""
    turns, done = itertools.count(), itertools.count(1)

    def policy(*_: object) -> Selection:
        return Selection(next(turns) % 2, 0.0, 0.0)

    result = replay(
        scans,
        box,
        study.config.health,
        None if sets is None else policy,
        sets,
        PERIOD,
        lambda: progress(what, next(done), len(scans)),
    )
    errors = sub_trajectory_rte(
        T_ref_sensor, result.trajectory.T_world_sensor, study.config.sub_trajectory
    )
    if np.isnan(errors).all():
        raise AdaptuneError(
            f"{what}: holds no sub-trajectory of {study.config.sub_trajectory:g} m; make "
            f"sub_trajectory shorter, or give --seconds more"
        )
    return float(np.nanmean(errors)), 1e3 * result.seconds / len(scans)
