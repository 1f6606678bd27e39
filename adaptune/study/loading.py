"""Reading a study: its YAML, the overrides, and all mistakes with their lines."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from adaptune import yaml
from adaptune.errors import AdaptuneError
from adaptune.plain_words import Key
from adaptune.sequence import cache
from adaptune.sequence.config import SequenceConfig
from adaptune.sequence.opening import check_sequence
from adaptune.study.config import StudyConfig
from adaptune.study.learned import Added, LearnedDrives
from adaptune.study.mistakes import ConfigurationError, Mistake, validated, validated_rest
from adaptune.study.odometries import check_odometries, check_together
from adaptune.study.overlaps import overlaps
from adaptune.study.roles import settle_roles
from adaptune.study.study import Study

_MOST_BYTES = 10**6

C = TypeVar("C", bound=StudyConfig)


def read_study(
    path: Path,
    config_type: type[C],
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    runs: Path = Path("runs"),
) -> Study[C]:
    """Read and check the YAML of a study, with the drives that it has learned from.

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
    # Before the overrides: they have the last word on these drives, too.
    added = LearnedDrives.read(folder).merge(data, path)
    overridden = [_override(data, text) for text in overrides]
    config, mistakes = _check(config_type, data, path.parent.resolve())
    if mistakes or config is None:
        lines = _lines(mistakes, _Sources(path, document, added), overridden)
        raise ConfigurationError("\n".join(dict.fromkeys(lines)))
    return Study(config, folder)


class _Sources(NamedTuple):
    """The files of a study's data."""

    path: Path
    document: yaml.Document
    added: Added

    def find(self, key: Key) -> tuple[bool, int, Key]:
        """Whether a key stands in the file of what was learned, its line (0: none), and its key."""
        learned, own = self.added.place(key)
        line = self.added.learned.line(own) if learned else self.document.line(own)
        return learned, line or 0, own


def _lines(
    mistakes: Iterable[Mistake], sources: _Sources, overridden: Sequence[Key]
) -> Iterable[str]:
    """A line for every mistake, in the order of the files."""
    for mistake in sorted(mistakes, key=lambda mistake: sources.find(mistake.key)[:2]):
        yield _say(mistake, sources, overridden)


def _read(path: Path) -> yaml.Document:
    try:
        if path.exists() and not (path.is_file() and path.stat().st_size <= _MOST_BYTES):
            raise ConfigurationError(f"{path}: a study is a file of YAML, of 1 MB at most")
        document = yaml.Document.of_file(path)
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read as text ({error})") from error
    except yaml.YamlError as error:
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
        data[last] = yaml.scalar(value)
    except yaml.YamlError as error:
        raise ConfigurationError(f"-o {text}: {error}") from error
    return path


def _say(mistake: Mistake, sources: _Sources, overridden: Sequence[Key]) -> str:
    key = mistake.key
    # The mistake of a whole section may be the mistake of a value in it.
    if any(key[: len(o)] == o[: len(key)] for o in overridden):
        where = "-o"
    else:
        learned, line, key = sources.find(key)
        path = sources.added.learned.path if learned else sources.path
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
