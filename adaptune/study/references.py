"""Estimate the references of a study's sequences that have none."""

import json
import logging
import math
import os
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from adaptune.cores import pin
from adaptune.reference import estimate
from adaptune.reference.estimated import EstimateError
from adaptune.reference.prior import warn_of_unused
from adaptune.reference.stored import StoredEstimate, write_estimate
from adaptune.sequence.fingerprint import fingerprints
from adaptune.sequence.names import origin
from adaptune.sequence.opening import (
    of_prior,
    open_unseen,
    position_prior,
    prior_files,
    wants_estimate,
)
from adaptune.study.study import Study

_CHANGES = {
    "estimator": "adaptune estimates it in another way",
    "scans": "its scans are others",
    "prior": "its position prior is another",
}
"""What a reference depends on, and what is said when that has changed."""

_log = logging.getLogger(__name__)


def ensure_references(
    study: Study,
    names: Iterable[str],
    progress: Callable[[str, int, int], None] = lambda *_: None,
    required: bool = True,
) -> None:
    """Estimate the references that are to be estimated and are not yet, or of something else.

    An estimate is made from the scans as they were recorded, so the views of a sequence share it.
    It knows nothing of the study's odometry: what judges a bank is not built from its members.

    Parameters
    ----------
    study
        The study; its folder keeps them as ``references/<sequence>.tum``.
    names
        Of sequences, views, or courses, which have a reference of their own.
    progress
        Called about every scan.
    required
        Whether the sequences are of no use without. If not, those of which no reference can be
        estimated are warned of.

    Raises
    ------
    EstimateError
        If the reference of a sequence cannot be estimated.
    """
    due = [name for name in dict.fromkeys(map(origin, names)) if _is_due(study, name)]
    if not due:
        return
    study.open()
    # Open3D's results repeat on one core only.
    unpin = pin(os.getpid())
    try:
        for name in due:
            _estimate(study, name, partial(progress, f"{name}, estimating its reference"), required)
    finally:
        unpin()


def _is_due(study: Study, name: str) -> bool:
    """Whether the reference of a sequence must be estimated; why, if that was done before."""
    given = study.sequences.recordings.get(name)
    if given is None or not wants_estimate(given):
        return False
    stored = study.sequences.estimate(name)
    if stored is None:
        return True
    about = _about(study, name)
    changes = [said for key, said in _CHANGES.items() if stored.about.get(key) != about[key]]
    if changes:
        _log.info("%s: its reference is estimated again: %s", name, "; ".join(changes))
    return bool(changes)


def _about(study: Study, name: str) -> dict[str, Any]:
    """Everything that an estimated reference depends on, as plain data."""
    given = study.sequences.recordings[name]
    scans = study.sequences.identity(name)
    seen = {"views", "compensate"}
    scans["sequence"] = {key: v for key, v in scans["sequence"].items() if key not in seen}
    prior = None
    if given.position_prior is not None:
        files = prior_files(given)
        keys = {"child_frame", "extrinsic", "clock_offset", "max_gap"}
        prior = of_prior(given).model_dump(mode="json", include=keys)
        prior["poses"] = fingerprints(files) if files else given.position_prior
    about = {"estimator": estimate.VERSION, "scans": scans, "prior": prior}
    plain: dict[str, Any] = json.loads(json.dumps(about))
    return plain


def _estimate(study: Study, name: str, advance: Callable[[int, int], None], required: bool) -> None:
    given, path = study.sequences.recordings[name], study.sequences.estimate_path(name)
    about, scans, prior = _about(study, name), open_unseen(given), position_prior(given)
    try:
        found = estimate.estimate_reference(scans, advance, prior)
    except EstimateError as error:
        # What was estimated before is of something else.
        for suffix in (".json", ".tum", ".png"):
            path.with_suffix(suffix).unlink(missing_ok=True)
        where = "" if scans.name in str(error) else f"{scans.name}: "
        refused = f"{study.sequences.key(name)}: {where}{error}"
        if required:
            raise EstimateError(refused) from error
        _log.warning("%s; it is replayed without a reference, and not judged", refused)
        return
    warn_of_unused(name, prior, found)
    stored = write_estimate(path, found, about, study.config.sub_trajectory)
    _log.info(
        "%s: its reference is estimated, %.0f m; %s (%s)",
        name,
        stored.metres,
        accuracy_in_words(stored, study.config.sub_trajectory),
        path,
    )


def accuracy_in_words(stored: StoredEstimate, length: float) -> str:
    """How accurate an estimated reference is over `length` metres, and on how much of the path."""
    error = stored.error(length)
    own = "its own error is not known" if math.isnan(error) else f"its own error is {error:.2g} %"
    share = 100.0 * stored.unknown_share
    return f"{own} over {length:g} m, unknown for {share:.0f} % of the scans"


def estimates_of(study: Study, names: Iterable[str]) -> dict[str, StoredEstimate]:
    """The estimated references of those of the sequences that have one, by their names."""
    found = {name: study.sequences.estimate(name) for name in dict.fromkeys(map(origin, names))}
    return {name: stored for name, stored in found.items() if stored is not None}


def estimates_in_words(study: Study, names: Iterable[str]) -> list[str]:
    """A sentence that says which sequences are judged by an estimated reference, if any."""
    length = study.config.sub_trajectory
    each = [
        f"{name} ({accuracy_in_words(stored, length)})"
        for name, stored in estimates_of(study, names).items()
    ]
    if not each:
        return []
    return [f"Judged by an estimated reference: {'; '.join(each)}."]


def estimates_as_data(study: Study, names: Iterable[str]) -> dict[str, Any]:
    """The same as plain data, by the names of the sequences; empty if there is none."""
    length = study.config.sub_trajectory
    found = {}
    for name, stored in estimates_of(study, names).items():
        error = stored.error(length)
        found[name] = {
            "error_percent": None if math.isnan(error) else round(error, 4),
            "unknown_share": stored.unknown_share,
        }
    return found
