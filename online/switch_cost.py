"""What it costs to change parameters between scans, measured for a study's odometry."""

import itertools
import json
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from adaptune.bank.bank import Bank
from adaptune.bank.hand_over import HandOver
from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.geometry import Poses
from adaptune.metrics import sub_trajectory_rte, travelled
from adaptune.model import ErrorModel
from adaptune.odometry.base import Motions, OdometryInstance, WarmUp
from adaptune.odometry.factory import Factory
from adaptune.odometry.tracker import HealthCheck
from adaptune.recording.scan import Scan
from adaptune.selection import Selection
from adaptune.space import ParameterSet
from adaptune.study.inputs import check_inputs
from adaptune.study.references import ensure_references
from adaptune.study.study import Study, driven
from online.replay import replay

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

WARM_UPS = (4.0, 8.0, 12.0)
"""Seconds, of which a new instance sees every scan."""

PERIOD = 5.0
"""Seconds between switches."""

ENOUGH = 10
"""Sub-trajectories one after the other, from which on the ratios tell something."""


class Mechanism(NamedTuple):
    """A way to change parameters."""

    make: Callable[[], OdometryInstance]  # makes a new odometry
    sets: tuple[ParameterSet, ...]  # the sets to switch between; empty for no switches


class Recording(NamedTuple):
    """The beginning of a sequence, and what its errors are measured by."""

    name: str
    scans: Sequence[Scan]
    T_ref_sensor: Poses
    length: float


class Alternating:
    """Selects each set in turn."""

    def __init__(self, sets: Sequence[ParameterSet]):
        self._turns = itertools.cycle(enumerate(sets))

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """Ignore the scan."""

    def measure(self) -> None:
        """Do nothing."""

    def select(self) -> Selection:
        """Take the next set."""
        return Selection(*next(self._turns))


def measure_switching(
    study: Study, seconds: float = 60.0, progress: Progress = lambda *_: None
) -> tuple[list[dict[str, Any]], str]:
    """Switch every 5 s to the same parameters: whatever changes is the cost of switching.

    Parameters
    ----------
    study
        The study; its folder receives ``switching.json``.
    seconds
        How much of every training sequence is used.
    progress
        Called about every scan.

    Returns
    -------
    list of dict
        A row for every mechanism and warm-up: geometric mean over the sequences of the RTE as a
        ratio to that without switching, and mean milliseconds a scan.
    str
        What was measured, and whether it is enough.

    Raises
    ------
    AdaptuneError
        If a sequence is too short, or its reference unknown.
    """
    ensure_references(study, study.config.training, progress)
    check_inputs(study)
    study.open()
    warm_up, catch_up_scans = study.warm_up, study.config.online.switching.catch_up_scans
    mechanisms = _mechanisms(study.odometry, warm_up, catch_up_scans)
    ratios, times = ({what: list[float]() for what in mechanisms} for _ in range(2))
    metres = 0.0
    for name in study.config.training:
        recording = _read(study, name, seconds)
        metres += float(travelled(recording.T_ref_sensor)[-1])
        without = 0.0
        for what, mechanism in mechanisms.items():
            error, ms = _measure(recording, what, mechanism, study.config.health, progress)
            without = without or error
            ratios[what].append(error / max(without, 1e-12))
            times[what].append(ms)
    means = {what: float(np.exp(np.mean(np.log(r)))) for what, r in ratios.items()}
    rows: list[dict[str, Any]] = [
        {"mechanism": what, "RTE ratio": mean, "ms a scan": float(np.mean(times[what]))}
        | dict(zip(study.config.training, ratios[what], strict=True))
        for what, mean in means.items()
    ]
    # A bank never switches: where another way has less expected loss, one set follows another.
    live = study.mechanism != "hand_over" and study.odometry.description.live
    own = "live" if live else _name(warm_up)
    found = {
        "of": study.switching_identity(),
        "switch_cost": means[own] - 1.0,
        "seconds": seconds,
        "rows": rows,
    }
    write_text(study.folder / "switching.json", json.dumps(found, indent=2) + "\n")
    return rows, _caption(seconds, metres, study.config.sub_trajectory)


def _caption(seconds: float, metres: float, length: float) -> str:
    said = (
        f"Switches every {PERIOD:g} s to the same set, on the first {seconds:g} s of each training "
        f"sequence: {metres:.0f} m in all."
    )
    if metres >= ENOUGH * length:
        return said
    return (
        f"{said} That is less than {ENOUGH} sub-trajectories of {length:g} m, so the ratios are "
        f"mostly chance; take longer recordings, or --seconds more."
    )


def switch_cost_in_words(study: Study) -> str:
    """The switch cost of what `adaptune online` drives with the study's model."""
    cost = f"a switch costs {study.switch_cost():.1%} of the RTE"
    if not study.model_path.exists():
        return (
            f"If `online` will drive one set at a time, {cost}; a bank and the fixed set never "
            f"switch. `adaptune offline` decides which."
        )
    online = driven(study, ErrorModel.load(study.model_path))
    if online.switches:
        return f"{online.words} Then {cost}."
    if online.paper in ("live", "hand_over"):
        return f"{online.words} It never switches; `paper` does, and then {cost}."
    return f"{online.words} That has no switch cost."


def _read(study: Study, name: str, seconds: float) -> Recording:
    sequence = study.sequences.open(name)
    scans: list[Scan] = []
    for scan in sequence:
        if scans and (scan.stamp - scans[0].stamp) * 1e-9 > seconds:
            break
        scans.append(scan)
    reference = sequence.reference()
    if reference is None:
        help_ = "name its topic or file, or let adaptune estimate it (reference: estimated)"
        raise AdaptuneError(
            f"sequences.{name}: has no reference to measure errors against; {help_}"
        )
    T_ref_sensor = reference.at(np.array([scan.stamp for scan in scans], np.int64))
    return Recording(name, scans, T_ref_sensor, study.config.sub_trajectory)


def _mechanisms(odometry: Factory, warm_up: WarmUp, catch_up_scans: int) -> dict[str, Mechanism]:
    """Each mechanism that the odometry can have, by name; the first never switches."""

    def same(_: ParameterSet) -> OdometryInstance:
        return odometry()

    def hand_over(warm_up: WarmUp) -> Mechanism:
        return Mechanism(lambda: HandOver(same, names[0], warm_up, catch_up_scans), names)

    # Sets that differ in name only.
    names: tuple[ParameterSet, ...] = ({"number": 0}, {"number": 1})
    made = {"none": Mechanism(odometry, ())}
    if odometry.description.live:
        made["live"] = Mechanism(odometry, _alike(odometry.space.baseline))
    warm_ups = dict.fromkeys([*(WarmUp(s, s, 1) for s in WARM_UPS), warm_up])
    made |= {_name(one): hand_over(one) for one in warm_ups}
    bank = dict(enumerate(names))
    made["bank"] = Mechanism(lambda: Bank(same, bank, warm_up), names)
    return made


def _alike(parameters: ParameterSet) -> tuple[ParameterSet, ...]:
    """Two sets that differ so little that only the change itself has an effect."""
    nearly = {n: v * (1 + 1e-9) if isinstance(v, float) else v for n, v in parameters.items()}
    return parameters, nearly


def _name(warm_up: WarmUp) -> str:
    seconds, full_rate, stride = warm_up
    sparse = "" if stride == 1 or full_rate >= seconds else f", {full_rate:g} s in full"
    return f"hand_over, {seconds:g} s{sparse}"


def _measure(
    recording: Recording, what: str, mechanism: Mechanism, health: HealthCheck, progress: Progress
) -> tuple[float, float]:
    """Mean RTE in percent, and mean milliseconds a scan."""
    n, what = len(recording.scans), f"{recording.name}, {what}"
    selector = Alternating(mechanism.sets) if mechanism.sets else None
    odometry = mechanism.make()
    result = replay(
        recording.scans, odometry, health, selector, PERIOD, lambda at: progress(what, at.done, n)
    )
    odometry.close()
    T_odom_sensor = result.trajectory.T_world_sensor
    errors = sub_trajectory_rte(recording.T_ref_sensor, T_odom_sensor, recording.length)
    if np.isnan(errors).all():
        raise AdaptuneError(
            f"{what}: holds no sub-trajectory of {recording.length:g} m; make sub_trajectory "
            f"shorter, or give --seconds more"
        )
    return float(np.nanmean(errors)), 1e3 * result.seconds / n
