"""Trials on the test sequences, for what the best choice in hindsight would have been.

`adaptune oracle` runs them into an archive of their own. Nothing learns from it.
"""

import json
import logging
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive
from adaptune.files import write_text
from adaptune.model import ErrorModel
from adaptune.study.inputs import FILE, odometry_inputs
from adaptune.study.run_folder import differences
from adaptune.study.study import Study

_log = logging.getLogger(__name__)


class OracleErrors(NamedTuple):
    """Errors of several sets on a test sequence, as trials measure them.

    A trial restarts at the reference after a lost track. A replay does not.
    """

    stamps: NDArray[np.int64]  # (n_frames,): nanoseconds
    trials: tuple[int, ...]  # numbers of the sets, the fixed one's first if it is among them
    # (n_frames, n_sets): sub-trajectory RTE in percent, NaN without a sub-trajectory, infinite
    # where the track was lost.
    errors: NDArray[np.float32]


def oracle_archive(study: Study) -> Archive:
    """The archive of the trials on test sequences, which notes what they depend on."""
    archive = Archive(study.folder / "oracle")

    def note(name: str) -> None:
        path = archive.folder / name / FILE
        if not path.exists():
            write_text(path, json.dumps(_inputs(study, name), indent=1) + "\n")

    return Archive(archive.folder, note)


def _inputs(study: Study, name: str) -> dict[str, Any]:
    """Everything that trials on a sequence depend on, as plain data."""
    about = {"odometry": odometry_inputs(study)} | study.sequences.identity(name)
    plain: dict[str, Any] = json.loads(json.dumps(about | study.sequences.reference(name)))
    return plain


def oracle_changes(study: Study, name: str) -> list[str]:
    """What has changed since the trials on a test sequence were run; empty if nothing has.

    Without a note that can be read, nobody knows what they were run with.
    """
    folder = study.folder / "oracle" / name
    if not any(folder.glob("*.npz")):
        return []
    try:
        before = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return sorted(differences(before, _inputs(study, name)))
    except (OSError, ValueError, TypeError, AttributeError):
        return [FILE]


def read_oracle(study: Study, name: str, model: ErrorModel) -> OracleErrors | None:
    """The errors of a model's sets on a test sequence; None where `adaptune oracle` ran none.

    Trials that were run with something else than the study has now are left out, with a warning.

    Parameters
    ----------
    study
        The study.
    name
        Of the test sequence.
    model
        The sets are those of the model that were run.

    Raises
    ------
    ArchiveError
        If a file is damaged.
    """
    if changes := oracle_changes(study, name):
        _log.warning(
            "%s: the oracle's trials were run with another %s; run `adaptune oracle` again",
            name,
            ", ".join(changes),
        )
        return None
    archive = oracle_archive(study)
    finished = archive.finished(name)
    known = [t for t in model.sets if t in finished and finished[t].parameters == model.sets[t]]
    if not known:
        return None
    trials = tuple(sorted(known, key=lambda trial: (trial != model.fixed, trial)))
    stamps = archive.read_frames(name).stamps
    return OracleErrors(stamps, trials, archive.read_errors(name, trials))
