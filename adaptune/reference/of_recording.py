"""Estimate the reference of a single recording, and compare it with the one that came with it."""

from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from adaptune.inspect import Inspection
from adaptune.reference.estimated import EstimatedReference, EstimateError
from adaptune.reference.given import MeasuredReference, mean_difference, measure_reference
from adaptune.reference.stored import StoredEstimate
from adaptune.sequence.config import ESTIMATED, SequenceConfig
from adaptune.sequence.opening import position_prior
from adaptune.sequence.sequence import Sequence
from adaptune.trajectory import Trajectory

if TYPE_CHECKING:
    # It would import what estimates.
    from adaptune.reference.estimate import Advance


def recording_config(
    found: Inspection, points: str | None = None, reference: str | None = None
) -> SequenceConfig:
    """The sequence that an inspected recording is.

    Parameters
    ----------
    found
        What `adaptune inspect` finds in it.
    points, reference
        Topics in place of those that were found; the reference may be a file, too.

    Raises
    ------
    EstimateError
        If there are no scans.
    """
    if not found.name:
        raise EstimateError(f"{found.path}: is a file of poses; give a recording of scans")
    if points is None and (lacking := found.missing["online"]):
        raise EstimateError(f"{found.path}: lacks {' and '.join(lacking)}; see `adaptune inspect`")
    given = found.config().model_dump(exclude_unset=True)
    chosen = {"points": points, "reference": reference}
    given |= {key: value for key, value in chosen.items() if value is not None}
    return SequenceConfig(**given)


def read_prior(config: SequenceConfig, source: str) -> Trajectory:
    """Positions that are right over long distances, from a topic of the recording or a file.

    Raises
    ------
    AdaptuneError
        If there are none, or they are of another time.
    """
    given = config.model_dump(exclude_unset=True, exclude={"max_gap"})
    joined = {"reference": ESTIMATED, "position_prior": source}
    prior = position_prior(SequenceConfig(**given | joined))
    if prior is None:
        raise EstimateError(
            f"--position-prior {source}: holds no pose; name a topic or a file of poses"
        )
    return prior


class Comparison(NamedTuple):
    """The reference that came with a recording beside the estimated one."""

    difference: float  # mean RTE of one by the other in percent; NaN without a sub-trajectory
    measured: MeasuredReference


def beside_given(
    scans: Sequence,
    given: Trajectory,
    found: EstimatedReference,
    length: float,
    advance: "Advance" = lambda *_: None,
) -> Comparison:
    """Compare an estimated reference with a given one, and measure the given one.

    Parameters
    ----------
    scans
        The recording.
    given
        The reference that came with it.
    found
        The estimated one.
    length
        Metres of the sub-trajectories.
    advance
        Called after every scan.
    """
    measured = measure_reference(scans, given, advance)
    T = np.where(found.known[:, None, None], found.T_world_sensor, np.nan)
    return Comparison(mean_difference(given.at(found.stamps), T, length), measured)


def check_writable(path: Path) -> None:
    """Make sure that an estimate can be written, and that nothing of the user's is overwritten.

    Raises
    ------
    EstimateError
        If the folder of the TUM file cannot be written to, or there is a file that is no estimate.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise EstimateError(
            f"{path.parent}: cannot be written to ({error.strerror}); write elsewhere with --out"
        ) from error
    if StoredEstimate.read(path) is None:
        files = (path.with_suffix(suffix) for suffix in (".tum", ".json", ".png"))
        if there := [file for file in files if file.exists()]:
            raise EstimateError(
                f"{there[0]}: is there, and is not of an estimate that is complete; move it away, "
                f"or write elsewhere with --out"
            )


def estimated_name(recording: Path) -> str:
    """Name of the file of its reference, without suffix."""
    return f"{recording.resolve().stem}_reference"
