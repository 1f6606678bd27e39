"""Reading a study: its YAML, the overrides, and all mistakes with their lines."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

from adaptune import files
from adaptune.errors import AdaptuneError, NotInstalledError, OdometryError, nearest
from adaptune.odometry.base import Description
from adaptune.odometry.registry import PROGRAMS, declare, is_user_class, odometry_class, where
from adaptune.recording import cache
from adaptune.recording.cache import MANY, fingerprint
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import check_sequence, interval_of, sequence_files
from adaptune.space import ODOMETRY, Categorical, Float, Integer, ParameterSpace, PooledSpace
from adaptune.strict import ConfigurationError, Key, Mistake, validated, validated_rest
from adaptune.study.config import RULES, OdometryConfig, StudyConfig, settle_roles
from adaptune.study.study import Study, describe_odometry, tuned_space, whole_definition

# Mistakes in the odometries of a study that only the odometries show.


_KINDS: dict[str, type[Float | Integer | Categorical]] = {
    "float": Float,
    "integer": Integer,
    "categorical": Categorical,
}


def check_odometries(data: Any, mistakes: list[Mistake], folder: Path) -> None:
    """Check each odometry by itself; make paths in its settings absolute.

    Parameters
    ----------
    data
        What stands under `odometry`: one, or a list of several.
    mistakes
        Receives what is wrong.
    folder
        Where relative paths begin.
    """
    if isinstance(data, dict):
        _check_odometry(data, ("odometry",), mistakes, folder)
    elif isinstance(data, list):
        for i, one in enumerate(data):
            given = {"name": one} if isinstance(one, str) else one
            if isinstance(given, dict):
                _check_odometry(given, ("odometry", i), mistakes, folder)


def check_together(config: StudyConfig) -> tuple[list[Mistake], ParameterSpace | None]:
    """Find what does not fit the other odometries, or the rest of the study.

    Returns
    -------
    mistakes : list of Mistake
    space : ParameterSpace, optional
        The parameters that are tuned; None if an odometry cannot be described.
    """
    given = config.odometry
    entries: dict[Key, OdometryConfig] = (
        {("odometry",): given}
        if isinstance(given, OdometryConfig)
        else {("odometry", i): one for i, one in enumerate(given)}
    )
    try:
        described = {key: describe_odometry(one) for key, one in entries.items()}
        spaces = {key: tuned_space(one, described[key]) for key, one in entries.items()}
    except OdometryError:
        return [], None
    mistakes = list(_check_each_once(entries, spaces))
    if len(entries) > 1:
        for key, about in described.items():
            if about.whole:
                message = f"{entries[key].name} runs whole recordings, and must be the only one"
                mistakes.append(Mistake((*key, "name"), message))
    for key, about in described.items():
        if about.needs_imu:
            mistakes += _check_imu(config, entries[key].name)
    labelled = {one.label or one.name: spaces[key] for key, one in entries.items()}
    space = PooledSpace(labelled) if len(entries) > 1 else next(iter(spaces.values()))
    if not mistakes:
        mistakes += _check_switching(config, list(described.values()), space)
    return mistakes, space


def _check_each_once(
    entries: Mapping[Key, OdometryConfig], spaces: Mapping[Key, ParameterSpace]
) -> Iterable[Mistake]:
    """Find odometries that would run the same sets twice, and labels that are given twice."""
    for (first, one), (key, other) in combinations(entries.items(), 2):
        settings, others = (declare(o.name, o.settings).settings for o in (one, other))
        alike = one.name == other.name and settings == others
        if alike and _have_a_common_set(spaces[first], spaces[key]):
            yield Mistake(
                key,
                f"{other.name} is there already (odometry.{first[-1]}) with the same settings, and "
                f"their parameters overlap, so sets would run twice; leave one out, or give it "
                f"other settings or ranges",
            )
        elif (one.label or one.name) == (other.label or other.name):
            yield Mistake(
                (*key, "label"),
                f"{one.label or one.name!r} is what odometry.{first[-1]} is called; give one of "
                f"the two a label of its own",
            )


def _have_a_common_set(one: ParameterSpace, other: ParameterSpace) -> bool:
    """Whether two spaces of the same odometry have a set in common."""
    return all(
        _meet(p, other.parameters[name])
        for name, p in one.parameters.items()
        if name in other.parameters
    )


def _meet(one: Any, other: Any) -> bool:
    if isinstance(one, Categorical) and isinstance(other, Categorical):
        return any(one.contains(choice) for choice in other.choices)
    if isinstance(one, Categorical) or isinstance(other, Categorical):
        return True
    return bool(one.low <= other.high and other.low <= one.high)


def _check_odometry(data: dict[str, Any], at: Key, mistakes: list[Mistake], folder: Path) -> None:
    """Check all that depends on the odometry; make paths in its settings absolute."""
    name = data.get("name")
    if not isinstance(name, str):
        return
    settings, key = data.get("settings") or {}, (*at, "settings")
    if not isinstance(settings, dict):
        return
    try:
        # A class of the user is imported in a process of its own.
        where(name) if is_user_class(name) else odometry_class(name)
    except OdometryError as error:
        mistakes.append(Mistake((*at, "name"), str(error)))
        return
    try:
        declared = declare(name, settings, folder)
        mistakes += (mistake.below(key) for mistake in declared.mistakes)
        if declared.settings is not None:
            data["settings"] = declared.settings.model_dump(mode="json", exclude_unset=True)
        if (described := declared.description) is None:
            return
        found: list[Mistake] = []
        _check_parameters(name, described.space, data.get("parameters"), found)
        mistakes += (mistake.below(at) for mistake in found)
        check = getattr(odometry_class(name), "check", None) if name in PROGRAMS else None
        if check is not None and isinstance(tuned := data.get("parameters"), dict):
            check(declared.settings, dict.fromkeys(tuned, 0))
    except NotInstalledError as error:
        mistakes.append(Mistake((*at, "name"), str(error)))
    except OdometryError as error:
        mistakes.append(Mistake((*at, "name") if is_user_class(name) else key, str(error)))


def _check_parameters(
    name: str, space: ParameterSpace | None, tuned: Any, mistakes: list[Mistake]
) -> None:
    if space is None and not tuned:
        message = f"define the parameters: a {name} does not know its own"
        mistakes.append(Mistake(("parameters",), message))
    for parameter, given in tuned.items() if isinstance(tuned, dict) else ():
        key = ("parameters", parameter)
        if space is not None and parameter not in space.names:
            mistakes.append(Mistake(key, _why_not_tuned(name, space, parameter)))
        elif isinstance(given, dict):
            whole = whole_definition(space, parameter, given)
            if str(whole.get("type")) not in _KINDS:
                mistakes.append(Mistake(key, f"give its type, one of {', '.join(_KINDS)}"))
            else:
                validated(_KINDS[whole["type"]], whole, key, mistakes)


def _why_not_tuned(name: str, space: ParameterSpace, parameter: Any) -> str:
    own: Any = None if is_user_class(name) or name in PROGRAMS else odometry_class(name)
    if own is not None and parameter in own.space.names:
        return f"{parameter} is fixed by settings; leave it out there to tune it"
    return f"{name} has no parameter {parameter!r}: {nearest(str(parameter), space.names)}"


def _check_imu(config: StudyConfig, odometry: str) -> Iterable[Mistake]:
    needs = f"{odometry} needs an IMU"
    for name, sequence in config.sequences.items():
        if sequence.imu is None:
            help_ = "name its topic and its place, imu: {topic: ..., extrinsic: ...}"
            yield Mistake(("sequences", name), f"{needs}; {help_}")
    for name, course in config.courses.items():
        if course.imu is None:
            yield Mistake(("courses", name), f"{needs}; simulate one, imu: 200")


def _check_set(at: Key, given: Mapping[str, Any], space: ParameterSpace) -> Iterable[Mistake]:
    """Find what is wrong with the names in a set that the study gives."""
    own = dict(given)
    if isinstance(space, PooledSpace):
        if ODOMETRY not in own:
            message = f"say which odometry it is for ({ODOMETRY}: {next(iter(space.spaces))})"
            yield Mistake(at, message)
            return
        if (label := own.pop(ODOMETRY)) not in space.spaces:
            message = f"there is no such odometry; {nearest(str(label), space.spaces)}"
            yield Mistake((*at, ODOMETRY), message)
            return
        space = space.spaces[label]
    for name in own:
        if name not in space.names:
            message = f"there is no such parameter; {nearest(name, space.names)}"
            yield Mistake((*at, name), message)


def _check_switching(
    config: StudyConfig, described: list[Description], space: ParameterSpace
) -> Iterable[Mistake]:
    online, key = config.online, ("online", "switching")
    for i, given in enumerate(online.switching.sets or ()):
        if isinstance(given, dict):
            yield from _check_set((*key, "sets", i), given, space)
    whole, names = any(one.whole for one in described), ", ".join(config.odometries)
    # A study's folder holds the defaults, too.
    if whole and online.rules and online.rules != RULES:
        message = f"{names} runs whole recordings and cannot adapt; leave this out"
        yield Mistake(("online", "modes"), message)
    live = len(described) == 1 and described[0].live
    if whole and online.switching.mechanism != "auto":
        message = f"{names} runs whole recordings and cannot change parameters; leave this out"
        yield Mistake((*key, "mechanism"), message)
    elif online.switching.mechanism == "live" and not live:
        message = f"{names} cannot change parameters between scans; choose auto or bank"
        yield Mistake((*key, "mechanism"), message)


# Recordings that a study trains on and tests on under two names.


_NOTES = (".txt", ".yaml")
"""Files beside scans: two recordings may have the same."""


def overlaps(config: StudyConfig) -> Iterator[Mistake]:
    """Find test sequences that hold scans of a training sequence, by the content of their files.

    Files are read only where their sizes agree.
    """
    for i, test in enumerate(config.test):
        for training in config.training:
            if test != training and _overlap(config, test, training):
                message = (
                    f"{test!r} is the recording of the training sequence {training!r}, and proves "
                    f"nothing here; leave one of them out, or give both a `start` or a `stop` so "
                    f"that they share no scan"
                )
                yield Mistake(("test", i), message)


def _overlap(config: StudyConfig, one: str, other: str) -> bool:
    if one in config.courses and other in config.courses:
        return config.courses[one] == config.courses[other]
    a, b = config.sequences.get(one), config.sequences.get(other)
    return a is not None and b is not None and share_scans(a, b)


def share_scans(a: SequenceConfig, b: SequenceConfig) -> bool:
    """Whether two sequences hold the same scans, by the content of their files.

    Raises
    ------
    SequenceError
        If one of them cannot be opened.
    """
    return _same_files(a, b) and _same_time(a, b)


def _same_files(a: SequenceConfig, b: SequenceConfig) -> bool:
    if a.evalio is not None and a.evalio == b.evalio:
        return True
    mine, others = _scan_files(a), _scan_files(b)
    if set(mine) & set(others):
        return True
    if len(mine) >= MANY:
        mine = [mine[0], mine[len(mine) // 2], mine[-1]]
    for file in mine:
        size = file.stat().st_size
        alike = [path for path in others if path.stat().st_size == size]
        if alike and fingerprint(file) in map(fingerprint, alike):
            return True
    return False


def _scan_files(config: SequenceConfig) -> Sequence[Path]:
    files = sequence_files(config).recording
    return [file.resolve() for file in files if file.suffix not in _NOTES]


def _same_time(a: SequenceConfig, b: SequenceConfig) -> bool:
    """Whether sections overlap, by the stamps of their recordings."""
    (begin, end), (other_begin, other_end) = interval_of(a), interval_of(b)
    return begin < other_end and other_begin < end


_MOST_BYTES = 10**6

C = TypeVar("C", bound=StudyConfig)


def read_study(
    path: Path,
    config_type: type[C],
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    runs: Path = Path("runs"),
) -> Study[C]:
    """Read and check the YAML of a study.

    Parameters
    ----------
    path
        The YAML.
    config_type
        The model of the YAML.
    overrides
        ``key.of.a.key=value``, the value in YAML.
    folder
        The study's folder; by default the YAML's name under `runs`.
    runs
        Folder of all studies.

    Raises
    ------
    ConfigurationError
        It lists all mistakes, each with its line, its key and what to do.
    """
    # A wrong variable is no mistake of the study.
    cache.folder()
    cache.cap()
    document, folder = _read(path), folder or runs / path.stem
    data: Any = document.data
    if (folder / "learned.yaml").exists():
        raise ConfigurationError(
            f"{folder / 'learned.yaml'}: `adaptune learn` is gone; name these drives under "
            f"`sequences` and `training` of {path}, and remove this file"
        )
    overridden = [_override(data, text) for text in overrides]
    config, mistakes = _check(config_type, data, path.parent.resolve())
    if mistakes or config is None:
        lines = _lines(mistakes, path, document, overridden)
        raise ConfigurationError("\n".join(dict.fromkeys(lines)))
    return Study(config, folder)


def _lines(
    mistakes: Iterable[Mistake], path: Path, document: files.Document, overridden: Sequence[Key]
) -> Iterable[str]:
    """A line for every mistake, in the order of the file."""
    for mistake in sorted(mistakes, key=lambda mistake: document.line(mistake.key) or 0):
        yield _say(mistake, path, document, overridden)


def _read(path: Path) -> files.Document:
    try:
        if path.exists() and not (path.is_file() and path.stat().st_size <= _MOST_BYTES):
            raise ConfigurationError(f"{path}: a study is a file of YAML, of 1 MB at most")
        document = files.Document.of_file(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read as text ({error})") from error
    except files.YamlError as error:
        raise ConfigurationError(str(error)) from error
    if not isinstance(document.data, dict):
        raise ConfigurationError(f"{path}: a study is a mapping of keys, see `adaptune --help`")
    return document


def _override(data: dict[str, Any], text: str) -> Key:
    """Set one key of nested mappings, and return its path."""
    dotted, equals, value = text.partition("=")
    if not equals or not dotted:
        raise ConfigurationError(f"-o {text}: give a key and a value, as in -o offline.trials=32")
    *parents, last = path = tuple(dotted.split("."))
    for part in parents:
        if data.get(part) is None:
            data[part] = {}
        data = data[part]
        if not isinstance(data, dict):
            raise ConfigurationError(f"-o {text}: {part} has no keys below it")
    try:
        data[last] = files.scalar(value)
    except files.YamlError as error:
        raise ConfigurationError(f"-o {text}: {error}") from error
    return path


def _say(mistake: Mistake, path: Path, document: files.Document, overridden: Sequence[Key]) -> str:
    key = mistake.key
    # The mistake of a whole section may be the mistake of a value in it.
    if any(key[: len(o)] == o[: len(key)] for o in overridden):
        where = "-o"
    else:
        line = document.line(key)
        where = f"{path}, line {line}" if line else str(path)
    dotted = ".".join(map(str, key))
    return f"{where}: {dotted + ': ' if dotted else ''}{mistake.message}"


def _check(
    config_type: type[C], data: dict[str, Any], folder: Path
) -> tuple[C | None, list[Mistake]]:
    """Validate a study's data, and find the mistakes that the models cannot find.

    Returns
    -------
    config : StudyConfig, optional
        None if the data are not valid.
    mistakes : list of Mistake
    """
    mistakes: list[Mistake] = []
    check_odometries(data.get("odometry"), mistakes, folder)
    origins, in_roles = settle_roles(data)
    mistakes += in_roles
    context = {"folder": folder}
    config = validated(config_type, data, (), mistakes, context)
    sound = all(mistake.key[:1] != ("odometry",) for mistake in mistakes)
    if config is None:
        needed = {"odometry": {"name": ""}, "training": [""]}
        config = validated_rest(config_type, data, needed, mistakes, context)
    if config is not None:
        space = None
        if sound:
            found, space = check_together(config)
            mistakes += found
        mistakes += config.mistakes(space)
    sequences, courses = data.get("sequences", {}), data.get("courses", {})
    if not isinstance(sequences, dict) or not isinstance(courses, dict):
        return None, mistakes
    mistakes += [
        Mistake(("courses", name), "there is a sequence of the same name")
        for name in sequences
        if name in courses
    ]
    for name, entry in sequences.items():
        if name not in origins:
            mistakes += _check_recording(name, entry, folder)
    if config is not None and not mistakes:
        mistakes += overlaps(config)
    return config, [_at_origin(mistake, origins) for mistake in mistakes]


def _at_origin(mistake: Mistake, origins: Mapping[str, str]) -> Mistake:
    """The mistake of a part of a sequence as that of the sequence."""
    kind, *names = mistake.key or ("",)
    if kind in ("sequences", "courses") and names and names[0] in origins:
        return mistake._replace(key=(kind, origins[str(names[0])], *names[1:]))
    return mistake


def _check_recording(name: str, entry: Any, folder: Path) -> Iterable[Mistake]:
    """Open a recording; mistakes in the entry itself were found with the whole."""
    config = validated(SequenceConfig, entry, (), [], {"folder": folder})
    if config is not None:
        try:
            check_sequence(config)
        except AdaptuneError as error:
            yield Mistake(("sequences", name), str(error))
