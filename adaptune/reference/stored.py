"""Files of an estimated reference: its poses as TUM, and beside them what is known about them."""

import json
import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import numpy as np

from adaptune._system.files import DAMAGED_NPZ, replacing, write_text
from adaptune.reference.estimated import EstimatedReference, EstimateError, Registrations
from adaptune.report.charts import Axis, Chart, Drawn, Line, Panel, Points, Spans
from adaptune.report.drawing import draw_chart
from adaptune.trajectory import write_tum

LENGTHS = (1.0, 2.0, 5.0, 10.0, 25.0, 50.0, 100.0, 200.0, 400.0, 800.0)
"""Metres over which the error of a reference is noted."""
_BEYOND = 1.5  # by how much a length may exceed the longest that is noted


class StoredEstimate(NamedTuple):
    """What is known about an estimated reference in a file."""

    path: Path  # of its TUM file
    about: dict[str, Any]  # what it was estimated from, as plain data
    scans: int
    metres: float  # length of its path
    unknown_share: float  # share of the scans whose pose is unknown
    errors: dict[float, float]  # its mean RTE in percent, by the length of sub-trajectories
    # From when to when it is unknown, and why; seconds since the first scan.
    unknown: Sequence[tuple[float, float, str]] = ()

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

        There is an `EstimateError` if the file beside it is damaged.
        """
        about = path.with_suffix(".json")
        try:
            known = json.loads(about.read_text(encoding="utf-8"))
            if "refused" in known:
                return None
            errors = {float(length): float(e) for length, e in known["error_percent"].items()}
            numbers = int(known["scans"]), float(known["metres"]), float(known["unknown_share"])
            unknown = [
                (float(a), float(b), str(why)) for a, b, why in known.get("unknown_seconds", ())
            ]
            return cls(path, dict(known["about"]), *numbers, errors, unknown)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise EstimateError(
                f"{about}: is damaged ({error}); remove it and {path.name}, and estimate the "
                f"reference again"
            ) from error


def write_estimate(path: Path, found: EstimatedReference, about: dict[str, Any]) -> StoredEstimate:
    """Write ``.png``, ``.tum`` and, last, ``.json``: without that, it does not count as one."""
    by_length = {length: found.error(length) for length in LENGTHS}
    errors = {length: round(e, 4) for length, e in by_length.items() if math.isfinite(e)}
    metres, share = round(found.path(), 3), round(found.unknown_share(), 4)
    spans = ((gap.seconds or (0.0, 0.0), gap.what) for gap in found.gaps())
    gaps = [(round(begin, 3), round(end, 3), what) for (begin, end), what in spans]
    stored = StoredEstimate(path, about, len(found.stamps), metres, share, errors, gaps)
    path.parent.mkdir(parents=True, exist_ok=True)
    # What is known of an estimate before is not of these poses.
    path.with_suffix(".json").unlink(missing_ok=True)
    draw_chart(estimate_chart(path.stem, found), path.with_suffix(".png"))
    write_tum(path, found.trajectory())
    known = stored._asdict() | {"error_percent": errors, "unknown_seconds": gaps}
    del known["path"], known["errors"], known["unknown"]
    write_text(path.with_suffix(".json"), json.dumps(known, indent=1) + "\n")
    return stored


def keep(path: Path, found: EstimatedReference) -> None:
    """Write all of an estimate to a ``.npz`` file, where that is possible."""
    arrays = vars(found) | found.registrations._asdict()
    del arrays["registrations"]
    with suppress(OSError), replacing(path) as temporary:
        np.savez_compressed(temporary, **arrays)


def kept(path: Path) -> EstimatedReference | None:
    """The estimate in a ``.npz`` file; None if there is none, or it is damaged."""
    try:
        with np.load(path) as file:
            arrays = dict(file)
        registrations = Registrations(*map(arrays.pop, Registrations._fields))
        return EstimatedReference(**arrays, registrations=registrations)
    except (*DAMAGED_NPZ, KeyError):
        return None


def check_writable(path: Path) -> None:
    """Make the folder of an estimate; an `EstimateError` if it, or a file there, is not for one."""
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


class Refusal(NamedTuple):
    """Why no reference could be estimated."""

    about: dict[str, Any]  # what it was to be estimated from, as plain data
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


def estimate_chart(title: str, found: EstimatedReference) -> Chart:
    """The path, the residuals of the registrations, and where it is not to be trusted."""
    x, y = found.known_poses[:, :2, 3].T
    drawn: tuple[Drawn, ...] = Line(x, y, "path"), Points(x[:1], y[:1], "start", shape="cross")
    path = Panel(Axis("x [m]"), Axis("y [m]"), drawn, "path", equal=True)
    seconds, registrations = (found.stamps - found.stamps[0]) * 1e-9, found.registrations
    differs = 100.0 * registrations.residual
    failed = np.isnan(differs)
    centimetres = np.where(failed, 2.0 * np.max(differs[~failed], initial=1.0), differs)
    drawn = tuple(
        Points(
            seconds[registrations.end[which]],
            np.maximum(centimetres[which], 0.01),
            f"{which.sum()} {what}",
        )
        for what, which in (
            ("differ", ~registrations.accepted & ~failed),
            ("agree", registrations.accepted),
            ("failed", failed),
        )
        if which.any()
    )
    gaps = [Spans(gap.seconds or (), ("unknown",), "unknown") for gap in found.gaps()]
    time = Axis("time [s]", limits=(0.0, max(float(seconds[-1]), 1.0)))
    differ = Axis("differ from the reference by [cm]", log=True)
    of_hops = Panel(time, differ, (*drawn, *gaps), "registrations over 2, 5 and 10 m")
    return Chart("estimate", title, (path, of_hops))
