"""Parameter files made from a template: YAML, JSON, TOML, and the layouts of ROS 1 and ROS 2."""

import json
import re
import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import tomli_w
import yaml as pyyaml

from adaptune import files
from adaptune.errors import OdometryError, nearest
from adaptune.space import ParameterSet

_YAML = (lambda text: files.Document(text).data, files.dump)
_FORMATS: dict[str, tuple[Callable[[str], Any], Callable[[Any], str]]] = {
    ".yaml": _YAML,
    ".yml": _YAML,
    ".json": (json.loads, lambda data: json.dumps(data, indent=2) + "\n"),
    ".toml": (tomllib.loads, tomli_w.dumps),
}
"""Functions that read and write a format, by a file's suffix."""

_ROS2 = "ros__parameters"

_Place = tuple[tuple[str, ...], Any, Any, tuple[Any, ...]]
"""Path of a value, what holds it, under which key, and all keys as they are."""


class Template:
    """A parameter file with values to be replaced.

    A parameter's name is its keys from the outermost on, with points or slashes between them.
    Leading keys may be left out if the rest names one value only. Points and slashes within a key,
    as in ROS, separate keys too; ROS 2's ``ros__parameters`` does not count.

    Parameters
    ----------
    path
        Its suffix gives the format. There is an `OdometryError` if it cannot be read.
    """

    def __init__(self, path: Path):
        self.path = path
        if path.suffix not in _FORMATS:
            raise OdometryError(f"{path}: a template is a file of {', '.join(_FORMATS)}")
        read, self._write = _FORMATS[path.suffix]
        try:
            self._text = path.read_text(encoding="utf-8")
            self._data = read(self._text)
        except FileNotFoundError as error:
            raise OdometryError(f"{path}: there is no such file") from error
        except (OSError, ValueError, files.YamlError) as error:
            raise OdometryError(f"{path}: {error}") from error
        held = isinstance(self._data, dict | list)
        self._places = list(_places(self._data)) if held else []

    def holds(self, name: str) -> bool:
        """Whether there is such a value; an error if there are several."""
        return self._find(name) is not None

    def path_of(self, name: str) -> tuple[str, ...]:
        """Keys of a value, from the outermost on; none if there is no such value."""
        place = self._find(name)
        return () if place is None else place[0]

    @property
    def names(self) -> list[str]:
        """Paths of all values."""
        return [".".join(path) for path, *_ in self._places]

    def value(self, name: str) -> Any:
        """A value; an `OdometryError` if there is none of this name, or several."""
        if (place := self._find(name)) is None:
            known = nearest(name, self.names)
            raise OdometryError(f"{self.path.name} has no such value; {known}")
        return place[1][place[2]]

    def fill(self, parameters: Mapping[str, Any]) -> str:
        """The file's text with new values; parameters that are not in it are ignored.

        A real number stays one where the new value is whole. All else in a YAML file stays as it
        is, because its readers differ in what they take for a number or a truth value. Only
        numbers such as ``1e3``, which ROS 1 takes for a text, are written as 1000.0.
        """
        changed = []
        for name, value in parameters.items():
            if (place := self._find(name)) is not None:
                _, held_in, key, _ = place
                # ROS 1 and other readers tell 20 from 20.0.
                real = isinstance(held_in[key], float) and type(value) is int
                held_in[key] = float(value) if real else value
                changed.append(place)
        written = self._write(self._data)
        if self.path.suffix in (".yaml", ".yml"):
            return _replaced(self._text, self._places, changed, self._data) or written
        return written

    def _find(self, name: str) -> _Place | None:
        wanted = _parts(name)
        found = [place for place in self._places if place[0][-len(wanted) :] == wanted]
        if len(found) > 1:
            found = [place for place in found if place[0] == wanted] or found
        if len(found) > 1:
            paths = ", ".join(".".join(path) for path, *_ in found)
            raise OdometryError(f"{self.path}: {name!r} may be any of {paths}; name one of them")
        return found[0] if found else None


def _parts(name: Any) -> tuple[str, ...]:
    return tuple(part for part in re.split(r"[./]", str(name)) if part)


def _places(data: Any, path: tuple[str, ...] = (), keys: tuple[Any, ...] = ()) -> Iterator[_Place]:
    """Every value that is neither a mapping nor a list of them."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        below = path if key == _ROS2 else path + _parts(key)
        if isinstance(value, dict | list) and value:
            yield from _places(value, below, (*keys, key))
        else:
            yield below, data, key, (*keys, key)


def _replaced(
    text: str, places: Iterable[_Place], changed: Iterable[_Place], data: Any
) -> str | None:
    """A YAML text with the new values in their places; None where that is not possible."""
    document = files.Document(text)
    names = {keys for *_, keys in changed}
    spans = []
    for _, held_in, key, keys in places:
        span, value = document.span(keys), held_in[key]
        if span is None:
            continue
        if keys in names or (isinstance(value, float) and not _is_number(text[slice(*span)])):
            spans.append((*span, files.dump([value]).removeprefix("- ").strip()))
    for begin, end, new in sorted(spans, reverse=True):
        text = text[:begin] + new + text[end:]
    try:
        return text if files.Document(text).data == data else None
    except files.YamlError:
        return None


def _is_number(text: str) -> bool:
    """Whether readers of YAML 1.1, as ROS 1, take a text for a number."""
    try:
        return isinstance(pyyaml.safe_load(text), int | float)
    except pyyaml.YAMLError:
        return False


_PLACEHOLDER = re.compile(r"\{([\w./-]+)\}")


def placeholders(argument: str) -> list[str]:
    """Names in braces."""
    return _PLACEHOLDER.findall(argument)


def replace(argument: str, values: Mapping[str, Any]) -> str:
    """Replace names in braces by their values; names without a value stay."""

    def text(match: re.Match[str]) -> str:
        value = values.get(match[1], match[0])
        return str(value).lower() if isinstance(value, bool) else str(value)

    return _PLACEHOLDER.sub(text, argument)


def check_names(
    parameters: ParameterSet, template: Template | None, command: Collection[str]
) -> None:
    """Raise an `OdometryError` if a parameter is neither in the template nor in the arguments."""
    inside = {name for argument in command for name in placeholders(argument)}
    for name in parameters:
        if name in inside or (template is not None and template.holds(name)):
            continue
        lacking = "there is no template"
        if template is not None:
            lacking = f"{template.path.name} has no such value; {nearest(name, template.names)}"
        unless = f"no argument holds {{{name}}}, and " if command else ""
        raise OdometryError(f"{name}: {unless}{lacking}")
