"""Whether positions that are right over long distances were of use to an estimate."""

import logging

from adaptune.reference.estimated import EstimatedReference
from adaptune.reference.graph import positions
from adaptune.trajectory import Trajectory

_log = logging.getLogger(__name__)


def warn_of_unused(name: str, prior: Trajectory | None, found: EstimatedReference) -> None:
    """Warn if there was a prior, and too few scans have a position by it.

    Parameters
    ----------
    name
        Of the recording.
    prior
        The positions that the estimate was to join, if any.
    found
        The estimate.
    """
    if prior is None or positions(prior, found.stamps, found.T_world_sensor) is not None:
        return
    _log.warning(
        "%s: the position prior was not used: too few scans lie between two of its positions that "
        "are at most %g s apart; give a larger max_gap, or check clock_offset",
        name,
        prior.max_gap,
    )
