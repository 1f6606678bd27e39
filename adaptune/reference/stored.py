"""Files of an estimated reference: its poses as TUM, and beside them what is known about them."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from adaptune.files import write_text
from adaptune.reference.estimated import EstimatedReference, EstimateError
from adaptune.trajectory import write_tum

LENGTHS = (1.0, 2.0, 5.0, 10.0, 25.0, 50.0, 100.0, 200.0, 400.0, 800.0)
"""Metres over which the error of a reference is noted."""
_BEYOND = 1.5
"""By how much a length may exceed the longest that is noted."""

CHECK = ".check"
"""Ends the name of an estimate that is compared with a given reference, and used for nothing
else."""


class StoredEstimate(NamedTuple):
    """What is known about an estimated reference in a file.

    Attributes
    ----------
    path : Path
        Its TUM file.
    about : dict
        What it was estimated from, as plain data.
    scans : int
        Number of scans.
    metres : float
        Length of its path.
    unknown_share : float
        Share of the scans whose pose is unknown.
    errors : dict
        Its estimated mean RTE in percent, by the length of sub-trajectories in metres.
    """

    path: Path
    about: dict[str, Any]
    scans: int
    metres: float
    unknown_share: float
    errors: dict[float, float]

    @classmethod
    def of(cls, path: Path, found: EstimatedReference, about: dict[str, Any]) -> "StoredEstimate":
        """What is known about an estimate that is to be written to `path`."""
        by_length = {length: found.error(length) for length in LENGTHS}
        errors = {length: round(e, 4) for length, e in by_length.items() if math.isfinite(e)}
        return cls(
            path,
            about,
            len(found.stamps),
            round(found.path(), 3),
            round(found.unknown_share(), 4),
            errors,
        )

    def error(self, length: float) -> float:
        """Estimated mean RTE of the reference in percent over `length` metres; NaN if unknown."""
        lengths = sorted(self.errors)
        if not lengths or length > _BEYOND * lengths[-1]:
            return math.nan
        if length < lengths[0]:  # as many metres as over the shortest
            return self.errors[lengths[0]] * lengths[0] / length
        values = np.log([max(self.errors[known], 1e-4) for known in lengths])
        return float(np.exp(np.interp(np.log(length), np.log(lengths), values)))

    @classmethod
    def read(cls, path: Path) -> "StoredEstimate | None":
        """What is known about the estimated reference in a TUM file; None if it is not one.

        Nor is it one where an estimate was refused, see `Refusal`.

        Raises
        ------
        EstimateError
            If the file beside it is damaged.
        """
        beside = path.with_suffix(".json")
        try:
            known = json.loads(beside.read_text(encoding="utf-8"))
            if "refused" in known:
                return None
            errors = {float(length): float(e) for length, e in known["error_percent"].items()}
            numbers = int(known["scans"]), float(known["metres"]), float(known["unknown_share"])
            return cls(path, dict(known["about"]), *numbers, errors)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise EstimateError(
                f"{beside}: is damaged ({error}); remove it and {path.name}, and estimate the "
                f"reference again"
            ) from error


def write_estimate(
    path: Path, found: EstimatedReference, about: dict[str, Any], length: float = 25.0
) -> StoredEstimate:
    """Write ``.png``, ``.tum`` and, last, ``.json``.

    If it is interrupted, no ``.json`` is there, and so nothing that counts as an estimate.

    Parameters
    ----------
    path
        The TUM file.
    found
        The reference.
    about
        What it was estimated from, as plain data.
    length
        Metres over which the picture tells its error.
    """
    stored = StoredEstimate.of(path, found, about)
    path.parent.mkdir(parents=True, exist_ok=True)
    # What is known of an estimate before is not of these poses.
    path.with_suffix(".json").unlink(missing_ok=True)
    # It imports Matplotlib.
    from adaptune.reference.picture import draw_estimate

    draw_estimate(path.with_suffix(".png"), path.stem, found, stored, length)
    write_tum(path, found.trajectory())
    known = stored._asdict() | {"error_percent": stored.errors}
    known["unknown_seconds"] = [
        [round(gap.begin, 3), round(gap.end, 3), gap.reason] for gap in found.gaps()
    ]
    del known["path"], known["errors"]
    write_text(path.with_suffix(".json"), json.dumps(known, indent=1) + "\n")
    return stored


class Refusal(NamedTuple):
    """Why no reference could be estimated.

    Attributes
    ----------
    about : dict
        What it was to be estimated from, as plain data.
    refused : str
        The reason.
    """

    about: dict[str, Any]
    refused: str

    @classmethod
    def read(cls, path: Path) -> "Refusal | None":
        """Why there is no estimate in a TUM file; None if it was not refused, or is unreadable."""
        try:
            known = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            return cls(dict(known["about"]), str(known["refused"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, path: Path) -> None:
        """Keep it beside where the TUM file would be; an estimate that is there is removed."""
        for suffix in (".json", ".tum", ".png"):
            path.with_suffix(suffix).unlink(missing_ok=True)
        write_text(path.with_suffix(".json"), json.dumps(self._asdict(), indent=1) + "\n")
