"""What a result was computed from: recorded beside it, compared, and said where it differs.

Every result (described sequence, trial, model, replay, estimated reference) has its inputs as plain
data beside it, with their digest. Trials and replays are in folders named by it: what has other
inputs is another result, and nothing is lost.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from adaptune._system.files import write_text
from adaptune._system.strict import ConfigurationError, in_one_line

FILE = "inputs.json"
"""In the folder of a result."""
SHORT = 12
"""Digits of a digest in the name of a folder."""
_MAX_VALUE = 60
"""Characters of a value in words."""
_CONTENTS = ("content", "descriptors", "recording", "reference", "scans")
"""Keys whose values are digests of files, or versions."""

Inputs = Mapping[str, Any]
"""All that a result was computed from, as plain data."""


def plain(inputs: Any) -> Any:
    """Data as they are read from a file: lists for tuples, texts for keys."""
    return json.loads(json.dumps(inputs, default=_scalar))


def _scalar(value: Any) -> Any:
    """A number of numpy as Python's own."""
    if not hasattr(value, "dtype"):
        raise TypeError(f"{type(value).__name__} is no plain data")
    return value.item()


def digest(inputs: Any) -> str:
    """Digest of inputs. The order of their keys does not matter, that of lists does."""
    text = json.dumps(inputs, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def merged(inputs: Iterable[Inputs]) -> dict[str, Any]:
    """The inputs of several results as those of one that is made of all of them."""
    found: dict[str, Any] = {}
    for each in inputs:
        for key, value in each.items():
            both = isinstance(value, dict) and isinstance(found.get(key), dict)
            found[key] = merged([found[key], value]) if both else value
    return found


def record(path: Path, inputs: Inputs) -> None:
    """Write what a result was computed from."""
    about = {"digest": digest(inputs), "inputs": inputs}
    write_text(path, json.dumps(about, indent=1) + "\n")


def recorded(path: Path) -> dict[str, Any] | None:
    """What a result was computed from; None if that was not recorded, an error if it is damaged."""
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        inputs = dict(about["inputs"])
        problem = None if about["digest"] == digest(inputs) else "its content is not what it was"
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        inputs, problem = {}, in_one_line(error)
    if problem:
        what = path.parent if path.name == FILE else path
        raise ConfigurationError(
            f"{path}: is damaged ({problem}); remove {what} and run the same command again"
        )
    return inputs


def changes(
    before: Inputs | None, now: Inputs, files: Mapping[str, Sequence[Path]] | None = None
) -> list[str]:
    """In what inputs differ from those of a result, in words; empty if in nothing.

    Those of the result are None if they were not recorded. `files` has, by the dotted key of a list
    of digests, the files that these are of.
    """
    if before is None:
        return ["an older adaptune did not record what it depends on"]
    found = list(differences(before, plain(now)))
    if any(key == "odometry.name" for key, *_ in found):
        same = ("odometry.settings", "odometry.parameters", "content")  # of another odometry
        found = [each for each in found if not each[0].startswith(same)]
    said = (words for key, was, is_ in found for words in _words(key, was, is_, files or {}))
    return list(dict.fromkeys(said))


def differences(before: Any, now: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Dotted keys by which nested data differ, in order, and the values of both."""
    if isinstance(before, dict) and isinstance(now, dict):
        for name in sorted(before.keys() | now.keys()):
            below = f"{key}.{name}" if key else str(name)
            yield from differences(before.get(name), now.get(name), below)
    elif before != now:
        yield key, before, now


def _words(key: str, was: Any, now: Any, files: Mapping[str, Sequence[Path]]) -> Iterator[str]:
    kind, _, rest = key.partition(".")
    if was is None or now is None:
        yield f"{rest or key if kind in _CONTENTS else key} is {'new' if was is None else 'gone'}"
    elif kind not in _CONTENTS or rest.startswith("version of "):
        what = f"the {rest}" if kind in _CONTENTS else key
        texts = [v if isinstance(v, str) else json.dumps(v) for v in (was, now)]
        short = max(map(len, texts)) <= _MAX_VALUE
        yield f"{what} changed from {' to '.join(texts)}" if short else f"{what} has another value"
    else:
        named = _changed_files(was, now, files[key]) if key in files else [rest or key]
        for each in named:
            yield f"{each} has other content"


def _changed_files(was: Sequence[str], now: Sequence[str], files: Sequence[Path]) -> list[Any]:
    if len(was) == len(now) == len(files):
        return [file for file, a, b in zip(files, was, now, strict=True) if a != b]
    return [files[0].parent if files else "the reference"]
