"""Reading a study: its YAML, the overrides, and all mistakes with their lines."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from adaptune import yaml
from adaptune.study.checking import check
from adaptune.study.config import StudyConfig
from adaptune.study.mistakes import ConfigurationError, Key, Mistake
from adaptune.study.study import Study

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
    document = _read(path)
    data: Any = document.data
    overridden = [_override(data, text) for text in overrides]
    config, mistakes = check(config_type, data, path.parent.resolve())
    if mistakes or config is None:
        mistakes.sort(key=lambda mistake: document.line(mistake.key) or 0)
        lines = [_say(mistake, path, document, overridden) for mistake in mistakes]
        raise ConfigurationError("\n".join(dict.fromkeys(lines)))
    return Study(config, folder or runs / path.stem)


def _read(path: Path) -> yaml.Document:
    try:
        document = yaml.Document(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigurationError(f"{path}: there is no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f"{path}: cannot be read as text ({error})") from error
    except yaml.YamlError as error:
        raise ConfigurationError(f"{path}: {error}") from error
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
        data = data.setdefault(part, {})
        if not isinstance(data, dict):
            raise ConfigurationError(f"-o {text}: {part} has no keys below it")
    try:
        data[last] = yaml.scalar(value)
    except yaml.YamlError as error:
        raise ConfigurationError(f"-o {text}: {error}") from error
    return path


def _say(mistake: Mistake, path: Path, document: yaml.Document, overridden: Sequence[Key]) -> str:
    key = mistake.key
    # The mistake of a whole section may be the mistake of a value in it.
    if any(key[: len(o)] == o[: len(key)] for o in overridden):
        where = "-o"
    else:
        line = document.line(key)
        where = f"{path}, line {line}" if line else str(path)
    dotted = ".".join(map(str, key))
    return f"{where}: {dotted + ': ' if dotted else ''}{mistake.message}"
