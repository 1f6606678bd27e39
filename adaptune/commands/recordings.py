"""The recordings that a command is given: bags, or folders of them."""

import shlex
from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from adaptune.commands.terminal import progress, say
from adaptune.errors import AdaptuneError
from adaptune.progress import Progress

if TYPE_CHECKING:
    from adaptune.recording.fleet import Reading
    from adaptune.recording.inspect import Inspection


def check_no_study(path: Path) -> None:
    """Refuse a study where a recording is expected."""
    if path.suffix in (".yaml", ".yml") or (path / "study.yaml").is_file():
        raise AdaptuneError(
            f"{path}: is a study, not a recording; `adaptune offline`, `online` and `compare` take "
            f"it, and `adaptune inspect` takes its folder once it has a model"
        )


class Asked(NamedTuple):
    """For what a study is decided."""

    recordings: Sequence[Path]  # or folders of them
    odometry: str
    points: str | None = None
    reference: str | None = None
    config: Path | None = None  # the user's parameter file
    test: Sequence[Path] = ()
    reading: "Reading | None" = None

    @property
    def line(self) -> str:
        """The first line of the study."""
        words = [*(str(bag.resolve()) for bag in self.recordings), "--odometry", self.odometry]
        given = [("--points", self.points), ("--reference", self.reference)]
        given += [("--config", str(self.config.resolve()) if self.config else None)]
        given += [*(("--test", str(bag.resolve())) for bag in self.test), ("--as", self.reading)]
        words += [word for key, value in given if value for word in (key, value)]
        # A name may hold the end of a line, or what is no character.
        plain = (c if c.isprintable() else ascii(c)[1:-1] for c in shlex.join(words))
        return f"# adaptune tune {''.join(plain)}\n"


def recorded(asked: Asked) -> "tuple[dict[str, Inspection], list[str]]":
    """The recordings by the names of their sequences, and the names of those for the test."""
    from adaptune.recording.fleet import check_alike, recordings_at

    for path in asked.recordings:
        check_no_study(path)
    tested, others = (recordings_at(p, asked.reading) for p in (asked.test, asked.recordings))
    kept = {path.resolve() for path in tested}
    paths = [*(path for path in others if path.resolve() not in kept), *tested]
    for path in paths:
        if [one.resolve() for one in paths].count(path.resolve()) > 1:
            raise AdaptuneError(f"{path}: is named twice; the test needs a recording of its own")
    if tested and len(paths) == len(tested):
        raise AdaptuneError("--test: leaves no recording to tune on")
    if len(paths) > 1 and asked.reference is not None and Path(asked.reference).is_file():
        raise AdaptuneError(
            f"--reference {asked.reference}: is a file, and of {len(paths)} recordings each needs "
            f"its own; write a study file, see docs/your-bag.md"
        )
    with progress() as show:
        found = [usable(path, asked.points, asked.reference, show) for path in paths]
    check_alike(found)
    named: dict[str, Inspection] = {}
    for one in found:
        names = chain([one.name], (f"{one.name}_{i}" for i in count(2)))
        named[next(name for name in names if name not in named)] = one
    return named, list(named)[len(paths) - len(tested) :]


def usable(path: Path, points: str | None, reference: str | None, show: Progress) -> "Inspection":
    """Look at a recording; it has scans of one topic, and a reference or is to get one."""
    from adaptune.recording.clouds import CLOUDS
    from adaptune.recording.inspect import inspect as inspect_file
    from adaptune.reference.estimate import recording_config

    check_no_study(path)
    found = inspect_file(path, False, show)
    clouds = [topic for topic in found.topics.values() if topic.type in CLOUDS]
    if len(clouds) > 1 and points is None:
        each = ", ".join(f"{one.name} ({one.count:,} of {one.type})" for one in clouds)
        raise AdaptuneError(
            f"{path}: has {len(clouds)} topics of point clouds: {each}; name one with --points"
        )
    recording_config(found, points, reference)
    if reference is None and found.missing["offline"]:
        why = "; ".join(str(one) for one in found.findings if one.of == "reference")
        say(f"{path}: its reference does not serve ({why}): one is estimated")
        found.given["reference"] = "estimated"
    return found
