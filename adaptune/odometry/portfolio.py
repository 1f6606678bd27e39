"""A portfolio: a few parameter sets of an odometry, of which one does well in nearly each place."""

from collections.abc import Collection, Iterable
from functools import cache
from pathlib import Path
from typing import Literal, NamedTuple, Self

import numpy as np
from pydantic import Field

from adaptune._system import manifest
from adaptune._system.strict import StrictModel, validated
from adaptune._system.yaml12 import Document
from adaptune.errors import AdaptuneError, Finding, nearest
from adaptune.recording.cache import status_key
from adaptune.recording.scan import Scan
from adaptune.space import ParameterSet, ParameterSpace, Value

FOLDER = Path(__file__).parent / "portfolios"
"""Those that adaptune brings, a file for each odometry."""
SECTOR = 10
"""Degrees of a sector in which a sensor sees something, or nothing."""
FAR = 1.5
"""By so large a factor, scans are beyond those that a portfolio was chosen on."""


class PortfolioError(AdaptuneError):
    """A portfolio that cannot be used."""


class ScanKind(NamedTuple):
    """What tells one kind of sensor from another."""

    rate: float  # scans a second
    points: int  # of a scan
    view: int  # degrees, seen from above

    @classmethod
    def of(cls, scan: Scan, rate: float) -> Self:
        """The kind of a scan."""
        azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
        return cls(rate, len(scan), SECTOR * len(np.unique(azimuth // SECTOR % (360 // SECTOR))))


_Axis = Literal["rate", "points", "view"]


class Member(StrictModel):
    """A parameter set of a portfolio, and what it is good for."""

    parameters: dict[str, Value] = Field(min_length=1)
    good_for: str = ""


class Portfolio(StrictModel):
    """What a file says; ``docs/portfolios.md`` describes every key."""

    odometry: str
    sets: tuple[Member, ...] = Field(min_length=2)  # the first is the baseline
    made: str = ""  # on this day
    version: str = ""  # by this adaptune
    tables: str = ""  # digest of the tables that it was chosen by
    courses: tuple[str, ...] = ()
    recordings: tuple[str, ...] = ()
    # The least and the most of what it was chosen on, see `ScanKind`.
    scans: dict[_Axis, tuple[float, float]] = Field(default_factory=dict)
    # By course and recording, the errors of the sets in times the baseline's.
    ratios: dict[str, tuple[float, ...]] = Field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Tells it from others."""
        return manifest.digest(self.model_dump(mode="json"))[:12]

    def unlike(self, kind: ScanKind) -> str:
        """How scans differ from all that it was chosen on, in words; empty if they do not."""
        known = ((name, getattr(kind, name), *ends) for name, ends in self.scans.items())
        return ", ".join(
            f"{name} {value:g} (it was chosen on {low:g} to {high:g})"
            for name, value, low, high in known
            if not low / FAR <= value <= high * FAR
        )

    def fitting(
        self, space: ParameterSpace, known: Collection[str]
    ) -> tuple[list[ParameterSet], list[str]]:
        """The sets but the baseline as sets of a space, and what must be said of them.

        `known` are the names of all parameters of the odometry, tuned or not; there is a
        PortfolioError if it has no such parameter.
        """
        base, sets, left_out = self.sets[0].parameters, list[ParameterSet](), list[str]()
        for i, one in enumerate(self.sets):
            for name in one.parameters:
                if name not in known:
                    what = f"{self.odometry} has no parameter {name!r}: {nearest(name, known)}"
                    raise PortfolioError(f"sets.{i}.parameters.{name}: {what}")
            own = space.complete({k: v for k, v in one.parameters.items() if k in space.names})
            wrong = [k for k, p in space.parameters.items() if not p.contains(own[k])]
            untuned = [k for k in one.parameters if k not in own]
            wrong += [k for k in untuned if one.parameters[k] != base.get(k)]
            if i and wrong:
                left_out.append(f"set {i} ({', '.join(wrong)})")
            elif i and own != space.baseline and own not in sets:
                sets.append(own)
        why = "because they are outside of the ranges, or move what is not tuned"
        said = [f"left out: {'; '.join(left_out)}, {why}"] if left_out else []
        if other := [k for k, v in space.baseline.items() if base.get(k, v) != v]:
            said.append(f"was chosen with another baseline ({', '.join(other)})")
        return sets, said


def path_of(name: str) -> Path:
    """The file of a portfolio: the one that adaptune brings of an odometry, or a user's."""
    given = Path(name)
    return given if given.is_absolute() or given.suffix else FOLDER / f"{name}.yaml"


def read_portfolio(name: str) -> Portfolio:
    """Read a portfolio; an AdaptuneError names the file, the line and the key of each mistake."""
    path = path_of(name)
    return _read(path, status_key(path) if path.is_file() else "")


@cache
def _read(path: Path, status: str) -> Portfolio:  # noqa: ARG001 - it tells other content
    document, mistakes = Document.of_file(path), list[Finding]()
    if (found := validated(Portfolio, document.data, (), mistakes)) is None:
        said = (f"{document.where(path, one.where)}: {one}" for one in mistakes)
        raise PortfolioError("\n".join(said))
    return found


def portfolios_of(odometries: Iterable[str], given: str | None = None) -> dict[str, str]:
    """The portfolios of some odometries, as a study names them: those that adaptune brings.

    One that is `given`, a file, takes the place of its odometry's; `none` stands for none.
    """
    if given == "none":
        return {}
    there = {name: name for name in odometries if (FOLDER / f"{name}.yaml").exists()}
    if given is not None:
        there[read_portfolio(given).odometry] = given
    return {name: read_portfolio(name).digest for name in there.values()}
