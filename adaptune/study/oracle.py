"""What trials on the test sequences found: the best choice in hindsight, not learnt from."""

import logging
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive
from adaptune.model import ErrorModel

_log = logging.getLogger(__name__)


class OracleErrors(NamedTuple):
    """Errors of several sets on a test sequence, as trials measure them."""

    trials: tuple[int, ...]  # numbers of the sets, the fixed one's first if it is among them
    # (n_frames, n_sets): sub-trajectory RTE in percent, NaN without a sub-trajectory, infinite
    # where the track was lost.
    errors: NDArray[np.float32]


def oracle_errors(archive: Archive, name: str, model: ErrorModel) -> OracleErrors | None:
    """The errors of a model's sets on a test sequence, from the study's trials on it.

    None where no trials were run; those of other inputs than now are left out, with a warning. An
    ArchiveError says that a file is damaged.
    """
    finished = archive.finished(name)
    known = [t for t in model.sets if t in finished and finished[t].parameters == model.sets[t]]
    if not known:
        return None
    if changes := archive.changes(name):
        words = "%s: the oracle's trials are of other inputs: %s; run `adaptune online --oracle`"
        _log.warning(words, name, "; ".join(changes))
        return None
    trials = tuple(sorted(known, key=lambda trial: (trial != model.fixed, trial)))
    return OracleErrors(trials, archive.read_errors(name, trials))
