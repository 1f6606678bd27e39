"""Parameter files made from a template: YAML, also in the layouts of ROS 1 and ROS 2, and JSON."""

import copy
import json
import re
import textwrap
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import reduce
from multiprocessing import parent_process
from operator import getitem
from pathlib import Path
from typing import Any

from adaptune._system import yaml12
from adaptune.errors import OdometryError, nearest, warn_once
from adaptune.space import Categorical, Float, Integer, ParameterSet, ParameterSpace

_FILE_SUFFIXES = (".yaml", ".yml", ".json")
_ROS2 = "ros__parameters"

_Place = tuple[tuple[str, ...], Any, Any, tuple[Any, ...]]
"""Path of a value, what holds it, under which key, and all keys as they are."""


class Template:
    """A parameter file with values to be replaced, in the format of its suffix.

    A parameter's name is its keys from the outermost on, with points or slashes between them.
    Leading keys may be left out if the rest names one value only. Points and slashes within a key,
    as in ROS, separate keys too; ROS 2's ``/**`` and ``ros__parameters`` do not count. There is an
    `OdometryError` if the file cannot be read.
    """

    def __init__(self, path: Path):
        self.path = path
        if path.suffix not in _FILE_SUFFIXES:
            raise OdometryError(f"{path}: a template is a file of {', '.join(_FILE_SUFFIXES)}")
        try:
            # Ends of lines stay as they are, and comments in another encoding.
            self._text = path.read_bytes().decode(errors="surrogateescape")
            self._document = self._parsed(self._text)
        except FileNotFoundError as error:
            raise OdometryError(f"{path}: there is no such file") from error
        except (OSError, ValueError, yaml12.YamlError) as error:
            raise OdometryError(f"{path}: {error}") from error
        self._data: Any = self._document.data
        for name, line, first in self._document.again if parent_process() is None else ():
            what = f"{name} is given twice, first in line {first}; adaptune and ROS 1 take the last"
            warn_once(f"{path}, line {line}: {what} one, other programs may not; leave one out")
        held = isinstance(self._data, dict | list)
        self._places = list(_places(self._data)) if held else []

    def _parsed(self, text: str) -> yaml12.Document:
        if self.path.suffix == ".json":
            json.loads(text)
            # JSON is YAML but for tabs, which it has between values only.
            text = text.replace("\t", " ")
        if "\0" in text:
            raise ValueError("is not text in UTF-8; save it so")
        return yaml12.Document(re.sub("[\udc80-\udcff]", "?", text), foreign=True)

    def path_of(self, name: str) -> tuple[str, ...]:
        """Keys of a value, from the outermost on; none if there is no such, an error if several."""
        place = self._find(name)
        return () if place is None else place[0]

    def ros2_name(self, name: str) -> str:
        """Name of a value as ROS 2 has it: its keys below the node, with points between them."""
        if (place := self._find(name)) is None:
            return name
        keys = [str(key) for key in place[-1]]
        return ".".join(keys[keys.index(_ROS2) + 1 if _ROS2 in keys else 0 :])

    @property
    def ros2(self) -> bool:
        """Whether the file is laid out as ROS 2 wants it."""
        return any(_ROS2 in place[-1] for place in self._places)

    def warn_of_texts(self) -> None:
        """Log numbers that ROS 1 reads as texts: those with an exponent and without a point."""
        for path, held_in, key, keys in self._places:
            value = held_in[key]
            if isinstance(value, str) and _EXPONENT.fullmatch(value):
                begin, end = self._document.span(keys) or (0, 0)
                if self._text[begin:end] == value:
                    warn_once(
                        f"{self.path}:{self._document.line(keys)}: ROS 1 takes {'.'.join(path)}: "
                        f"{value} for a text, and many systems go back to their default then; "
                        f"write {float(value)}"
                    )

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

    def check_known(self, known: Collection[str], tool: str, under: str = "") -> None:
        """Refuse names that are not `known` to a tool in its sections, and warn of other numbers.

        ROS 2's layout has no sections of a tool. Only names `under` a path count.
        """
        sections = {name.partition(".")[0] for name in known if "." in name}
        last, others = {name.rpartition(".")[2] for name in known}, list[str]()
        for name, (path, held_in, key, keys) in zip(self.names, self._places, strict=True):
            if name in known or name in sections or not name.startswith(under):
                continue
            if not self.ros2 and not sections.isdisjoint(path[:1]):
                where = self._document.where(self.path, keys)
                what = f"{where}: {name}: {tool} has no such value; {nearest(name, known)}"
                raise OdometryError(what)
            if type(held_in[key]) in (int, float) and last.isdisjoint(path[-1:]):
                others.append(f"{name} (line {self._document.line(keys)})")
        if others:
            said = textwrap.shorten(", ".join(others), 400, placeholder=" ...")
            warn_once(f"{self.path}: nothing reads {said}: {tool} has no such value")

    def held(self, names: Iterable[str], under: str = "") -> dict[str, Any]:
        """The values of those names that the file has and that are not null, `under` a path."""
        return {
            name: value
            for name in names
            if self.path_of(under + name) and (value := self.value(under + name)) is not None
        }

    def based(self, space: ParameterSpace, under: str = "") -> ParameterSpace:
        """Those parameters of a space that the file holds, with its values as their baselines.

        Ranges widen to hold them. An `OdometryError` says that it holds none, or what is no value.
        """
        tuned: dict[str, Float | Integer | Categorical] = {}
        for name, value in self.held(space.names, under).items():
            own, changes = space.parameters[name], {"baseline": value}
            try:
                if not isinstance(own, Categorical):
                    # 1e-3 is a text to YAML 1.1.
                    number = value if type(value) is int else float(value)
                    changes = {"low": min(own.low, number), "high": max(own.high, number)}
                    changes["baseline"] = number
                tuned[name] = type(own).model_validate(own.model_dump() | changes)
            except (ValueError, TypeError) as error:
                line = self._document.where(self.path, (self._find(under + name) or ((),))[-1])
                kind = "whole number" if isinstance(own, Integer) else "number"
                what = f"{line}: {name}: {value!r} is no {kind} to begin at"
                raise OdometryError(what) from error
        if not tuned:
            raise OdometryError(
                f"{self.path}: holds none of {', '.join(under + name for name in space.names)}; "
                f"name the parameter file of this odometry"
            )
        return ParameterSpace(tuned)

    def fill(self, parameters: Mapping[str, Any]) -> str:
        """The file's text with new values; parameters that are not in it are ignored.

        A real number stays one where the new value is whole. All else, also a value that is the
        same, stays as it is, byte for byte. An `OdometryError` names a value that cannot be
        replaced alone.
        """
        changed, data = {}, copy.deepcopy(self._data)
        for name, value in parameters.items():
            if (place := self._find(name)) is not None:
                *_, key = keys = place[-1]
                held_in = reduce(getitem, keys[:-1], data)
                if type(value) is float and repr(value) == _number(held_in[key]):
                    continue
                real = isinstance(held_in[key], float) or _EXPONENT.fullmatch(str(held_in[key]))
                held_in[key] = float(value) if real and type(value) is int else value
                changed[keys] = held_in[key]
        return self._replaced(changed, data)

    def _replaced(self, changed: Mapping[tuple[Any, ...], Any], data: Any) -> str:
        """The text with new values in their places, by their keys."""
        text, spans = self._text, []
        for keys, value in changed.items():
            begin, end = self._document.span(keys) or (0, 0)
            new = yaml12.dump([value]).removeprefix("- ").strip()
            if self.path.suffix == ".json" and isinstance(value, str):
                new = json.dumps(value)
            spans.append((begin, end, new if begin < end else f" {new}"))
        for begin, end, new in sorted(spans, reverse=True):
            text = text[:begin] + new + text[end:]
        tagged = any(self._text.startswith("!", begin) for begin, *_ in spans)
        with suppress(yaml12.YamlError):
            # Where nan is nan.
            if not tagged and repr(self._parsed(text).data) == repr(data):
                return text
        where = ", ".join(str(self._document.line(keys)) for keys in changed)
        raise OdometryError(
            f"{self.path}: a parameter cannot be replaced alone (line {where}); write its value "
            f"without anchors, aliases and tags"
        )

    def _find(self, name: str) -> _Place | None:
        wanted = _parts(name)
        places = [place for place in self._places if place[0][-len(wanted) :] == wanted]
        if len(places) > 1:
            places = [place for place in places if place[0] == wanted] or places
        if len(places) > 1:
            paths = ", ".join(
                f"{'.'.join(path)} (line {self._document.line(keys)})" for path, *_, keys in places
            )
            raise OdometryError(f"{self.path}: {name!r} may be any of {paths}; name one of them")
        return places[0] if places else None


def _parts(name: Any) -> tuple[str, ...]:
    return tuple(part for part in re.split(r"[./]", str(name)) if part)


def _places(data: Any, path: tuple[str, ...] = (), keys: tuple[Any, ...] = ()) -> Iterator[_Place]:
    """Every value that is neither a mapping nor a list of them."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        below = path if key in (_ROS2, "/**") else path + _parts(key)
        if isinstance(value, dict | list) and value:
            yield from _places(value, below, (*keys, key))
        else:
            yield below, data, key, (*keys, key)


def _number(held: Any) -> str:
    """A number as Python writes it, also one that YAML 1.1 takes for a text."""
    with suppress(ValueError, TypeError):
        return repr(float(held))
    return ""


_EXPONENT = re.compile(r"[-+]?[.\d]+[eE][-+]?\d+")
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
        if name in inside or (template is not None and template.path_of(name)):
            continue
        lacking = "there is no template"
        if template is not None:
            lacking = f"{template.path.name} has no such value; {nearest(name, template.names)}"
        unless = f"no argument holds {{{name}}}, and " if command else ""
        raise OdometryError(f"{name}: {unless}{lacking}")
