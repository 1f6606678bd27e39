"""Estimate a reference from a recording alone."""

from collections.abc import Callable

from adaptune.reference.estimated import EstimatedReference
from adaptune.sequence.sequence import Sequence
from adaptune.trajectory import Trajectory

Advance = Callable[[int, int], None]
"""Called with how many scans are done, and about how many there are."""


def estimate_reference(
    scans: Sequence, advance: Advance = lambda *_: None, priors: Trajectory | None = None
) -> EstimatedReference:
    """Estimate the reference of a recording.

    Parameters
    ----------
    scans
        The recording; its own reference is not used.
    advance
        Called after every scan.
    priors
        Positions that are right over long distances only, as those of a GPS.

    Raises
    ------
    EstimateError
        If the recording does not allow it: the robot hardly moves, or nothing can be registered.
    """
    raise NotImplementedError
