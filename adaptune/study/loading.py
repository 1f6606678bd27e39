"""Reading a study: its YAML, the overrides, and its mistakes with their lines."""

import glob
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import combinations, product
from pathlib import Path
from typing import Any, TypeVar

from adaptune import errors
from adaptune._system import yaml12
from adaptune._system.strict import ConfigurationError, validated
from adaptune.errors import AdaptuneError, Finding, Key, NotInstalledError, OdometryError, nearest
from adaptune.odometry.base import Description
from adaptune.odometry.registry import (
    ABSENT,
    ODOMETRIES,
    PROGRAMS,
    classes,
    declare,
    is_user_class,
    odometry_class,
)
from adaptune.recording import cache
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import RecordedSequence
from adaptune.runs.archive import CURRENT, NAMED_BY_DIGEST
from adaptune.space import Categorical, Float, Integer, ParameterSpace, PooledSpace
from adaptune.study.config import (
    ROLES,
    OdometryConfig,
    OnlineConfig,
    StudyConfig,
    settle_roles,
    whole_definition,
)
from adaptune.study.study import Study

_SPACE_TYPES: dict[str, type[Float | Integer | Categorical]] = {
    "float": Float,
    "integer": Integer,
    "categorical": Categorical,
}


def _entries(given: Any) -> dict[Key, Any]:
    """The odometries of a study by their keys."""
    if isinstance(given, list | tuple):
        return {("odometry", i): one for i, one in enumerate(given)}
    return {("odometry",): given}


def _check_together(config: StudyConfig) -> tuple[list[Finding], ParameterSpace | None]:
    """Find what does not fit the other odometries, or the rest of the study.

    And the parameters that are tuned; None if an odometry cannot be described.
    """
    entries: dict[Key, OdometryConfig] = _entries(config.odometry)
    try:
        described = {key: one.declared[1] for key, one in entries.items()}
        spaces = {key: one.space for key, one in entries.items()}
    except OdometryError:
        return [], None
    mistakes = list(_check_labels(entries))
    if len(entries) > 1:
        for key, about in described.items():
            if about.whole:
                message = f"{entries[key].name} runs whole recordings, and must be the only one"
                mistakes.append(Finding((*key, "name"), message))
    for key, about in described.items():
        if about.needs_imu:
            mistakes += _check_imu(config, entries[key].name)
    labelled = {one.label or one.name: spaces[key] for key, one in entries.items()}
    space = PooledSpace(labelled) if len(entries) > 1 else next(iter(spaces.values()))
    if not mistakes:
        mistakes += _check_switching(config, list(described.values()))
    return mistakes, space


def _check_labels(entries: Mapping[Key, OdometryConfig]) -> Iterable[Finding]:
    """Find labels that are given twice."""
    for (first, one), (key, other) in combinations(entries.items(), 2):
        if (one.label or one.name) == (other.label or other.name):
            yield Finding(
                (*key, "label"),
                f"{one.label or one.name!r} is what odometry.{first[-1]} is called; give one of "
                f"the two a label of its own",
            )


def _check_odometry(
    data: dict[str, Any], at: Key, mistakes: list[Finding], folder: Path, needed: bool
) -> None:
    """Check an odometry by itself; make paths in its settings absolute.

    It is `needed` if it must be there: installed, and its image on this machine.
    """
    name, settings = data.get("name"), data.get("settings") or {}
    if not isinstance(name, str) or not isinstance(settings, dict):
        return  # the models find it
    at_fault = "name"
    ABSENT.discard(name)
    try:
        # A class of the user is imported in a process of its own.
        classes().where(name) if is_user_class(name) else odometry_class(name)
        at_fault = "name" if is_user_class(name) else "settings"
        declared = declare(name, settings, folder)
        mistakes += (mistake.below((*at, "settings")) for mistake in declared.mistakes)
        if declared.settings is not None:
            data["settings"] = declared.settings.model_dump(mode="json", exclude_unset=True)
        if (described := declared.description) is None:
            return
        tuned = data.get("parameters")
        found = _check_parameters(name, described.space, tuned)
        mistakes += (mistake.below((*at, "parameters")) for mistake in found)
        check = getattr(odometry_class(name), "check", None) if name in PROGRAMS else None
        if check is not None and isinstance(tuned, dict) and needed:
            check(declared.settings, dict.fromkeys(tuned, 0))
    except OdometryError as error:
        key = "name" if isinstance(error, NotInstalledError) else at_fault
        mistakes += [Finding((*at, key), str(error))] * needed
        # In a study's folder, the parameters are defined with nothing left to the class.
        ranges = [one for one in (data.get("parameters") or {}).values() if isinstance(one, dict)]
        if not needed and is_user_class(name) and ranges and all("type" in r for r in ranges):
            ABSENT.add(name)


def _check_parameters(name: str, space: ParameterSpace | None, tuned: Any) -> list[Finding]:
    mistakes: list[Finding] = []
    if space is None and tuned is None:
        mistakes.append(Finding((), f"define the parameters: a {name} does not know its own"))
    for parameter, given in tuned.items() if isinstance(tuned, dict) else ():
        if space is not None and parameter not in space.names:
            known = nearest(str(parameter), space.names)
            message = f"{name} has no parameter {parameter!r}: {known}"
            if name in ODOMETRIES and parameter in odometry_class(name).space.names:
                message = f"{parameter} is fixed by settings; leave it out there to tune it"
            mistakes.append(Finding((parameter,), message))
        elif isinstance(given, dict):
            whole = whole_definition(space, parameter, given)
            kind = str(whole.get("type"))
            keys, others = ["low", "high"], ["choices"]
            if kind == "categorical":
                keys, others = others, [*keys, "log"]
            if kind in _SPACE_TYPES and (wrong := [key for key in others if key in given]):
                own = whole_definition(space, parameter, {})
                usual = ", ".join(f"{key}: {json.dumps(own[key])}" for key in keys if key in own)
                what = f"takes {' and '.join(keys)}, not {' and '.join(wrong)}"
                mistakes.append(Finding((parameter,), what, usual and f"its own are {usual}"))
            elif kind in _SPACE_TYPES:
                validated(_SPACE_TYPES[whole["type"]], whole, (parameter,), mistakes)
            else:
                mistakes.append(
                    Finding((parameter,), f"give its type, one of {', '.join(_SPACE_TYPES)}")
                )
    return mistakes


def _check_imu(config: StudyConfig, odometry: str) -> Iterable[Finding]:
    needs = f"{odometry} needs an IMU"
    for name, sequence in config.sequences.items():
        if sequence.imu is None:
            help_ = "name its topic and its place, imu: {topic: ..., extrinsic: ...}"
            yield Finding(("sequences", name), f"{needs}; {help_}")
    for name, course in config.courses.items():
        if course.imu is None:
            yield Finding(("courses", name), f"{needs}; simulate one, imu: 200")


def _check_switching(config: StudyConfig, described: list[Description]) -> Iterable[Finding]:
    online, names = config.online, ", ".join(config.odometries)
    modes, mechanism = ("online", "modes"), ("online", "switching", "mechanism")
    if any(one.whole for one in described):
        message = f"{names} runs whole recordings and cannot change parameters; leave this out"
        # A study's folder holds the defaults, too.
        if online.rules not in ((), OnlineConfig().rules):
            yield Finding(modes, message)
        if online.switching.mechanism != "auto":
            yield Finding(mechanism, message)
    elif online.switching.mechanism == "live" and not (len(described) == 1 and described[0].live):
        message = f"{names} cannot change parameters between scans; choose auto or bank"
        yield Finding(mechanism, message)


def _overlaps(config: StudyConfig, opened: dict[str, RecordedSequence]) -> Iterator[Finding]:
    """Find test sequences that hold scans of a training sequence."""

    def same(*names: str) -> bool:
        if {*names} & config.courses.keys():
            a, b = map(config.courses.get, names)
            return a == b
        for name in {*names} - opened.keys():
            opened[name] = RecordedSequence(config.sequences[name])
        with suppress(AdaptuneError):  # training names a scan that cannot be read
            return opened[names[0]].shares_scans(opened[names[1]])
        return False

    for one, other in combinations(dict.fromkeys(config.training), 2):
        if same(one, other):
            what = f"training: {one!r} and {other!r} hold the same scans, which count twice"
            errors.warn_once(f"{what}; leave one of them out")
    for (i, test), training in product(enumerate(config.test), config.training):
        if test != training and same(test, training):
            message = (
                f"{test!r} is the recording of the training sequence {training!r}, and proves "
                f"nothing here; leave one of them out, or give both a `start` or a `stop` so "
                f"that they share no scan"
            )
            yield Finding(("test", i), message)


C = TypeVar("C", bound=StudyConfig)


def read_study(
    given: Path | Mapping[str, Any],
    config_type: type[C],
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    needed: bool = True,
) -> Study[C]:
    """Read and check a study, a file or its data, with ``key.of.a.key=value`` as overrides.

    The study's folder is by default the YAML's name under ``runs``; that of data must be given, and
    relative paths in these begin there. The odometry is `needed` if it must be there to run. A
    ConfigurationError lists mistakes, each with its line, its key and what to do.
    """
    # A wrong variable is no mistake of the study.
    cache.folder()
    cache.cap()
    if isinstance(given, Path):
        document, here = _read(given), given.parent.resolve()
        folder = folder or Path("runs") / given.stem
    elif folder is not None:
        document, here = yaml12.Document(yaml12.dump(given)), folder.resolve()
    else:
        raise ConfigurationError("a study that is no file needs a `folder`")
    data: Any = document.data
    for role in ROLES:  # 00 is a name there
        named = data.get(role) if isinstance(data.get(role), list) else []
        for i, name in enumerate(named):
            if not isinstance(name, str | list | dict):
                named[i] = document.name((role, i))
    overridden = [_override(data, text) for text in overrides]
    config, mistakes = _check(config_type, data, here, needed)
    if mistakes or config is None:
        mistakes.sort(key=lambda mistake: document.line(mistake.where) or 0)
        said = dict.fromkeys(_say(m, given, document, overridden) for m in mistakes)
        raise ConfigurationError("\n".join(said))
    for older in ("trials/*/inputs.json", "replays/*/reference.inputs.json"):
        now = (CURRENT, *(glob.escape(name) + NAMED_BY_DIGEST for name in config.training))
        of_now = any(any((folder / "trials").glob(one)) for one in now)
        if any(folder.glob(older)) and not of_now:
            what = "its trials and replays are of an older adaptune, which kept them in another way"
            raise ConfigurationError(f"{folder}: {what}; run again with another --folder")
    return Study(config, folder)


def _read(path: Path) -> yaml12.Document:
    if path.exists() and not (path.is_file() and path.stat().st_size <= 10**6):
        what = "a study is a file of YAML, of 1 MB at most"
        raise ConfigurationError(f"{path}: {what}; with a recording, begin by `adaptune tune`")
    try:
        document = yaml12.Document.of_file(path)
    except yaml12.YamlError as error:
        raise ConfigurationError(str(error)) from error
    if not isinstance(document.data, dict):
        raise ConfigurationError(f"{path}: a study is a mapping of keys, see `adaptune --help`")
    if document.data.keys().isdisjoint(("odometry", "sequences", "courses", "training")):
        raise ConfigurationError(
            f"{path}: is no study, it names no odometry and no recordings; a parameter file goes "
            f"with a bag, as --config, and is compared with --odometry and bags"
        )
    return document


def _override(data: dict[str, Any], text: str) -> Key:
    """Set one key of nested mappings, and return its path."""
    dotted, equals, value = text.partition("=")
    if not equals or not dotted:
        raise ConfigurationError(f"-o {text}: give a key and a value, as in -o offline.trials=32")
    path, rest = Key(), dotted.split(".")
    while True:
        # A name may hold dots itself.
        names = (".".join(rest[:n]) for n in range(len(rest), 0, -1))
        last = next((name for name in names if name in data), rest[0])
        path, rest = (*path, last), rest[last.count(".") + 1 :]
        if not rest:
            break
        if data.get(last) is None:
            data[last] = {}
        data = data[last]
        if not isinstance(data, dict):
            raise ConfigurationError(f"-o {text}: {last} has no keys below it")
    try:
        data[last] = yaml12.Document(value).data
    except yaml12.YamlError as error:
        raise ConfigurationError(f"-o {text}: {error}") from error
    return path


def _say(mistake: Finding, given: Any, document: yaml12.Document, overridden: Sequence[Key]) -> str:
    key = mistake.where
    # The mistake of a whole section may be the mistake of a value in it.
    if any(key[: len(o)] == o[: len(key)] for o in overridden):
        return f"-o: {mistake}"
    return f"{document.where(given, key)}: {mistake}" if isinstance(given, Path) else str(mistake)


def _check(
    config_type: type[C], data: dict[str, Any], folder: Path, needed: bool
) -> tuple[C | None, list[Finding]]:
    """Validate a study's data, and find the mistakes that the models cannot find.

    The configuration is None if the data are not valid.
    """
    mistakes: list[Finding] = []
    for key, one in _entries(data.get("odometry")).items():
        given = {"name": one} if isinstance(one, str) else one
        if isinstance(given, dict):
            _check_odometry(given, key, mistakes, folder, needed)
    origins, in_roles = settle_roles(data)
    mistakes += in_roles
    context = {"folder": folder}
    config = validated(config_type, data, (), mistakes, context)
    sound = all(mistake.where[:1] != ("odometry",) for mistake in mistakes)
    if config is not None:
        space = None
        if sound:
            found, space = _check_together(config)
            mistakes += found
        mistakes += config.mistakes(space)
    sequences, courses = data.get("sequences", {}), data.get("courses", {})
    if not isinstance(sequences, dict) or not isinstance(courses, dict):
        return None, mistakes
    mistakes += [
        Finding(("courses", name), "there is a sequence of the same name")
        for name in sequences
        if name in courses
    ]
    recorded = {name: entry for name, entry in sequences.items() if name not in origins}
    opened: dict[str, RecordedSequence] = {}
    mistakes += _check_recordings(recorded, context, opened)
    if config is not None and not mistakes:
        mistakes += _overlaps(config, opened)
    return config, [_at_origin(mistake, origins) for mistake in mistakes]


def _at_origin(mistake: Finding, origins: Mapping[str, str]) -> Finding:
    """The mistake of a part of a sequence as that of the sequence."""
    kind, *names = mistake.where or ("",)
    if kind in ("sequences", "courses") and names and names[0] in origins:
        return mistake._replace(where=(kind, origins[str(names[0])], *names[1:]))
    return mistake


def _check_recordings(
    sequences: Mapping[str, Any], context: Any, opened: dict[str, RecordedSequence]
) -> Iterable[Finding]:
    """Open recordings; mistakes in the entries themselves were found with the whole."""
    for name, entry in sequences.items():
        if (config := validated(SequenceConfig, entry, (), [], context)) is not None:
            try:
                recorded = RecordedSequence(config)
                recorded.check()
                opened[name] = recorded
            except AdaptuneError as error:
                yield Finding(("sequences", name), str(error))
