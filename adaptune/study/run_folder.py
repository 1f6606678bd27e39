"""The folder of a study: its lock, and the configuration that it was begun with."""

import fcntl
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import IO, Any

from adaptune import yaml
from adaptune.files import write_text
from adaptune.study.mistakes import ConfigurationError

CONFIGURATION = "study.yaml"
"""The resolved configuration."""
MODEL = "model.safetensors"
"""The error model."""

_locks: dict[str, IO[str]] = {}
"""Open files whose locks last as long as the process."""


def check_folder(
    folder: Path,
    resolved: Mapping[str, Any],
    lasting: Callable[[Mapping[str, Any]], dict[str, Any]],
) -> None:
    """Refuse a folder that was begun with another study.

    Raises
    ------
    ConfigurationError
        It names the keys that differ.
    """
    path = folder / CONFIGURATION
    if not path.exists():
        return
    try:
        data: Any = yaml.Document(path.read_text(encoding="utf-8")).data
        before = lasting(data)
    except (yaml.YamlError, UnicodeDecodeError, AttributeError, KeyError, TypeError) as error:
        raise ConfigurationError(
            f"{path}: is damaged ({error}); give this study another folder (--folder), or remove "
            f"that one"
        ) from error
    differing = sorted(differences(before, lasting(resolved)))
    # Without trials, nothing binds the folder to a configuration.
    if differing and any(folder.glob("trials/*/*.npz")):
        raise ConfigurationError(
            f"{folder} was begun with other values of {', '.join(differing)}; give this study "
            f"another folder (--folder), or remove that one"
        )


def open_folder(folder: Path, resolved: Mapping[str, Any]) -> None:
    """Make a study's folder, lock it while this process lives, and write the configuration.

    Raises
    ------
    ConfigurationError
        If the folder cannot be made, or another process works in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(
            f"{folder}: the study's folder cannot be made ({error.strerror}); name another with "
            f"--folder"
        ) from error
    if str(folder) not in _locks:
        lock = (folder / ".lock").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            lock.close()
            raise ConfigurationError(
                f"{folder}: another adaptune is at work here; wait for it, or give this study "
                f"another folder (--folder)"
            ) from error
        _locks[str(folder)] = lock
    write_text(folder / CONFIGURATION, yaml.dump(resolved))


def differences(a: Any, b: Any, path: str = "") -> Iterable[str]:
    """Paths of the values in which nested mappings differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in a.keys() | b.keys():
            yield from differences(a.get(key), b.get(key), f"{path}.{key}" if path else str(key))
    elif a != b:
        yield path
