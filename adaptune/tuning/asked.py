"""What a user asks to tune: recordings, or folders of them, and an odometry."""

import logging
import multiprocessing
import shlex
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

from adaptune._system import processes
from adaptune._system.files import plain_name
from adaptune._system.manifest import plain
from adaptune._system.progress import Progress
from adaptune.errors import AdaptuneError, NotInstalledError
from adaptune.odometry import Odometry, registry
from adaptune.odometry.content import module_file
from adaptune.recording.clouds import CLOUDS
from adaptune.recording.config import NO_REFERENCE
from adaptune.recording.fleet import Reading, check_alike, recordings_at
from adaptune.recording.inspect import Inspection
from adaptune.recording.inspect import inspect as inspect_file
from adaptune.reference.estimate import recording_config
from adaptune.study.config import read_budget

_log = logging.getLogger(__name__)


class Asked(NamedTuple):
    """For what a study is decided."""

    recordings: Sequence[Path]  # or folders of them
    odometry: str = "gicp"
    points: str | None = None
    reference: str | None = None
    config: Path | None = None  # the user's parameter file
    test: Sequence[Path] = ()
    reading: Reading | None = None
    about: Mapping[str, Any] = {}  # by odometry, its settings and parameters, if given
    trials: int | None = None
    minutes: float | None = None
    budget: float | str | None = None
    portfolio: str | None = None  # a file, or none; by default those that adaptune brings

    @property
    def limits(self) -> dict[str, float | str]:
        """What may be spent, by its keys in a study."""
        hours = None if self.minutes is None else self.minutes / 60.0
        limits: dict[str, Any] = {"offline.trials": self.trials, "offline.hours": hours}
        try:
            limits |= {"online.budget": read_budget(self.budget)}
        except ValueError as error:
            raise AdaptuneError(f"--budget {self.budget}: {error}") from error
        return dict(plain({key: v for key, v in limits.items() if v is not None}))

    @property
    def inputs(self) -> dict[str, Any]:
        """The rest as plain data, by which a study is known."""
        found = self._asdict() | {"config": self.config and str(self.config.resolve())}
        found |= {key: [str(p.resolve()) for p in found[key]] for key in ("recordings", "test")}
        spelt = {"reading": "--as", "about": "the odometry's object", "recordings": "BAG"}
        limits = ("trials", "minutes", "budget")
        return dict(plain({spelt.get(k, f"--{k}"): v for k, v in found.items() if k not in limits}))


def words_of(given: str) -> list[str]:
    """A command as words; a file's name is one."""
    try:
        return [given] if Path(given).exists() else shlex.split(given)
    except ValueError as error:  # of quotes
        raise AdaptuneError(f"{given}: {error}; put \\ before a quote in a name") from error


def check_no_study(path: Path) -> None:
    """Refuse a study where a recording is expected."""
    if path.suffix in (".yaml", ".yml") or (path / "study.yaml").is_file():
        raise AdaptuneError(
            f"{path}: is a study, not a recording; `adaptune offline`, `online` and `compare` take "
            f"it, and `adaptune inspect` takes its folder once it has a model"
        )


def recorded(
    asked: Asked, show: Progress, alike: bool = True
) -> tuple[dict[str, Inspection], list[str]]:
    """The recordings by the names of their sequences, and the names of those for the test.

    They are `alike`, see `check_alike`, where they tune one odometry.
    """
    for path in asked.recordings:
        check_no_study(path)
    tested, others = (recordings_at(p, asked.reading) for p in (asked.test, asked.recordings))
    kept = {path.resolve() for path in tested}
    paths = [*(path for path in others if path.resolve() not in kept), *tested]
    resolved = [path.resolve() for path in paths]
    for path in paths:
        if resolved.count(path.resolve()) > 1:
            why = "; the test needs a recording of its own" * alike
            raise AdaptuneError(f"{path}: is named twice{why}")
    if asked.reference == NO_REFERENCE:
        raise AdaptuneError(
            "--reference none: errors are measured by a reference; leave it out, and one is "
            "estimated where the recording has none"
        )
    if tested and len(paths) == len(tested):
        raise AdaptuneError("--test: leaves no recording to tune on")
    if len(paths) > 1 and asked.reference is not None and Path(asked.reference).is_file():
        raise AdaptuneError(
            f"--reference {asked.reference}: is a file, and of {len(paths)} recordings each needs "
            f"its own; write a study file, see docs/your-bag.md"
        )
    inspections = [usable(path, asked.points, asked.reference, show) for path in paths]
    if alike:
        check_alike(inspections)
    named: dict[str, Inspection] = {}
    for inspection in inspections:
        path = inspection.path
        longer = plain_name(path.with_name(f"{path.parent.name}_{path.name}"))
        names = chain([inspection.name, longer], (f"{inspection.name}_{i}" for i in count(2)))
        named[next(name for name in names if name not in named)] = inspection
    return named, list(named)[len(paths) - len(tested) :]


def usable(path: Path, points: str | None, reference: str | None, show: Progress) -> Inspection:
    """Look at a recording; it has scans of one topic, and a reference or is to get one."""
    check_no_study(path)
    found = inspect_file(path, False, show)
    clouds = [topic for topic in found.topics.values() if topic.type in CLOUDS]
    if len(clouds) > 1 and points is None:
        each = ", ".join(f"{topic.name} ({topic.count:,} of {topic.type})" for topic in clouds)
        raise AdaptuneError(
            f"{path}: has {len(clouds)} topics of point clouds: {each}; name one with --points"
        )
    recording_config(found, points, reference)
    if reference is None and found.missing["offline"]:
        why = "; ".join(str(finding) for finding in found.findings if finding.of == "reference")
        _log.warning("%s: its reference does not serve (%s): one is estimated", path, why)
        found.given["reference"] = "estimated"
    return found


def check_guarded(function: str) -> None:
    """Refuse to begin again in a process that was started by the same script."""
    started = getattr(sys.modules["__main__"], "__spec__", None)
    imported = started is not None and started.name == processes.__name__
    if imported or getattr(multiprocessing.current_process(), "_inheriting", False):
        raise AdaptuneError(
            f'call adaptune.{function} below `if __name__ == "__main__":`, because its workers '
            f"import the script"
        )


def named_odometry(given: Any) -> tuple[str, dict[str, Any]]:
    """The names of odometries in a study, and by name the settings and parameters of objects.

    The class of a script has the name that other processes import it by. A list's names are joined
    with commas.
    """
    if isinstance(given, str):
        return given, {}
    if isinstance(given, list | tuple) and given:
        each = [named_odometry(one) for one in given]
        about = {name: settings for _, of in each for name, settings in of.items()}
        return ",".join(name for name, _ in each), about
    cls = given if isinstance(given, type) else type(given)
    module, main = cls.__module__, getattr(sys.modules["__main__"], "__file__", None)
    if module == "__main__" and main and (file := module_file(Path(main).stem)):
        module = Path(main).stem if file.resolve() == Path(main).resolve() else module
    path = f"{module}:{cls.__qualname__}"
    name = next((name for name, where in registry.ODOMETRIES.items() if where == path), path)
    if isinstance(given, type):
        return name, {}
    if not isinstance(given, Odometry):
        raise AdaptuneError(
            "odometry: give a name, or several with commas; a class derived from "
            "adaptune.odometry.Odometry; an object of one; or a list of these"
        )
    parameters = {key: {"baseline": value} for key, value in given.parameters.items()}
    settings = given.settings.model_dump(mode="json", exclude_unset=True)
    return name, {name: {"settings": settings, "parameters": parameters}}


def odometries_of(given: str, imu: bool) -> list[str]:
    """The odometries that a name, several, or `all` stand for."""
    if given != "all":
        names = list(dict.fromkeys(filter(None, map(str.strip, given.split(",")))))
        if programs := [name for name in names if name in registry.PROGRAMS]:
            raise AdaptuneError(
                f"--odometry {programs[0]}: a program needs settings; write a study file, see "
                f"docs/programs.md"
            )
        return names
    there = []
    for name in registry.ODOMETRIES:
        with suppress(NotInstalledError):
            needs_imu = registry.declare(name, {}).sound(name)[1].needs_imu
            # The other one is the same KISS-ICP.
            if name != "evalio_kiss_icp" and (imu or not needs_imu):
                there.append(name)
    return there
