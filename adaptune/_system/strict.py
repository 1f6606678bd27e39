"""What a user sets, and what is wrong with it in plain words."""

import json
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from importlib.metadata import entry_points
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

from adaptune.errors import AdaptuneError, Finding, Key, in_a_line, nearest

_LARGEST = 10**100
"""No number is as large; the square of one is still a number."""

_UNTOUCHED = ("default", "metadata", "serialization")
"""Parts of a schema that hold no schemas."""


def _strict(schema: Any) -> Any:
    if isinstance(schema, list | tuple):
        return type(schema)(map(_strict, schema))
    if not isinstance(schema, dict) or schema.get("type") == "model":
        return schema
    if (kind := schema.get("type")) in ("int", "float"):
        return core_schema.no_info_wrap_validator_function(partial(_number, kind), schema)
    return {k: v if k in _UNTOUCHED else _strict(v) for k, v in schema.items()}


def _number(kind: str, given: Any, check: Callable[[Any], Any]) -> Any:
    """Refuse what is no number, and what no unit makes sensible."""
    if isinstance(given, bool | str | bytes):
        raise PydanticKnownError("int_type" if kind == "int" else "float_type")
    if kind == "int" and isinstance(given, float) and given.is_integer():
        given = int(given)
    if isinstance(given, int):
        given = max(-_LARGEST, min(given, _LARGEST))
    value = check(given)
    if abs(value) >= _LARGEST:
        limit = {"le": float(_LARGEST)} if value > 0 else {"ge": -float(_LARGEST)}
        raise PydanticKnownError("less_than_equal" if value > 0 else "greater_than_equal", limit)
    return value


class StrictModel(BaseModel):
    """Settings without unknown keys.

    Neither true nor text counts as a number, and all numbers are finite.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Make what checks the values: pydantic itself takes true for 1, and "1" as well."""
        schema = handler(source)
        model: Any = handler.resolve_ref_schema(schema)
        while model["type"] != "model":
            model = model["schema"]
        model["schema"] = _strict(model["schema"])
        return schema


UNKNOWN = "unknown key"

_LONGEST_VALUE = 60
"""Characters of a value that a message quotes."""

_NUMBER, _WHOLE, _LIST, _MAPPING = "a number", "a whole number", "a list", "keys with values"
_TYPE_WORDS = {
    **dict.fromkeys(("tuple", "list", "set", "frozen"), _LIST),
    **dict.fromkeys(("dict", "model"), _MAPPING),
    "float": _NUMBER,
    "int": _WHOLE,
    "finite": "a finite number",
    "bool": "true or false",
    "string": "text",
    "none": "nothing",
}
"""What to give, by the first word of pydantic's type of a mistake."""
_BOUNDS = {
    "greater_than": "a number above {gt:,.10g}",
    "greater_than_equal": "a number of at least {ge:,.10g}",
    "less_than": "a number below {lt:,.10g}",
    "less_than_equal": "a number of at most {le:,.10g}",
    "too_short": "at least {min_length:,}",
    "too_long": "at most {max_length:,}",
    "string_too_short": "at least {min_length:,} characters",
    "string_too_long": "at most {max_length:,} characters",
    "literal_error": "{expected}",
    "string_pattern_mismatch": "",  # pydantic's own words are better
}
"""What to give in place of a value of the right type."""


def plain_words(error: ValidationError, data: Any) -> dict[Key, str]:
    """What is wrong with data that are not valid, and what to give, by the key of each mistake."""
    found: dict[Key, list[Any]] = {}
    named = []
    for detail in error.errors(include_url=False):
        path = _path(data, detail)
        found.setdefault(path, []).append(detail)
        if detail["loc"][-1:] == ("[key]",):
            named.append(path)
    said = {}
    for path, details in found.items():
        # Of several types that are allowed, the one that the value comes nearest to counts.
        deeper = any(len(other) > len(path) and other[: len(path)] == path for other in found)
        if path in named or not deeper:
            said[path] = _message(details)
    return said


def in_one_line(error: Exception, data: Any = None) -> str:
    """An error in one line; in plain words where `data`, which may be unknown, are not valid."""
    if not isinstance(error, ValidationError):
        return " ".join(str(error).split())
    return "; ".join(str(Finding(*said)) for said in plain_words(error, data).items())


def _path(data: Any, detail: Any) -> Key:
    """Keys that lead to a mistake; between them, pydantic names the types that are allowed."""
    if data is None:
        return tuple(detail["loc"])
    path: list[str | int] = []
    for part in detail["loc"]:
        indexed = isinstance(data, list | tuple) and isinstance(part, int) and part < len(data)
        if indexed or (isinstance(data, dict) and part in data):
            data = data[part]
            path.append(part)
    return (*path, detail["loc"][-1]) if detail["type"] == "missing" else tuple(path)


def _message(details: Sequence[Any]) -> str:
    """What is wrong with a value, by each of the types that are allowed for it."""
    kinds = [detail["type"] for detail in details]
    if "extra_forbidden" in kinds:
        return UNKNOWN
    if "missing" in kinds:
        return "this key is missing"
    for detail in details:
        if not _wanted(detail):
            return _plain(str(detail["msg"]))
    # A value of the right type comes nearest.
    nearest = [detail for detail in details if detail["type"] in _BOUNDS] or list(details)
    wanted = [_wanted(detail) for detail in nearest]
    if _NUMBER in wanted and _WHOLE in wanted:
        wanted.remove(_WHOLE)
    return f"give {' or '.join(dict.fromkeys(wanted))}, not {_given(nearest[0])}"


def _wanted(detail: Any) -> str:
    """What to give; nothing for a mistake that pydantic has other words for."""
    kind = detail["type"]
    words = _BOUNDS.get(kind, _TYPE_WORDS.get(kind.partition("_")[0], ""))
    words = words.format(**detail.get("ctx", {}))
    return words.replace("True", "true").replace("False", "false")


def _given(detail: Any) -> str:
    """A value in few words, as YAML has it."""
    value = detail["input"]
    if detail["type"] in ("too_short", "too_long"):
        return f"{len(value):,}"
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return _MAPPING
    if isinstance(value, list | tuple):
        return _LIST
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 3]}..."


def _plain(message: str) -> str:
    """What a class of the user, or a rule of ours, says of a value, without pydantic's words."""
    message = re.sub(r"^(Value error|Assertion failed), ", "", message)
    message = re.sub(r"\b[Ii]nput should be\b", "give", message)
    return re.sub(r" (after|during) validation", "", message).replace("Input should", "it should")


M = TypeVar("M", bound=BaseModel)


class ConfigurationError(AdaptuneError):
    """One or more mistakes in a study's YAML, or in a parameter, a line each."""


def validated(
    model: type[M],
    data: Any,
    key: Key,
    mistakes: list[Finding],
    context: dict[str, Any] | None = None,
) -> M | None:
    """Validate a section; None if it has mistakes, which are added to `mistakes`."""
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        for path, message in plain_words(error, data).items():
            unknown = message == UNKNOWN
            help_ = f"; {nearest(str(path[-1]), _keys(model, path[:-1]))}" if unknown else ""
            mistakes.append(Finding(key + path, message + help_))
        return None


def alternatives(annotation: Any) -> Iterator[Any]:
    """The types of a union, without what is annotated to them."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        yield from alternatives(typing.get_args(annotation)[0])
    elif origin in (typing.Union, types.UnionType):
        for one in typing.get_args(annotation):
            yield from alternatives(one)
    else:
        yield annotation


def _keys(annotation: Any, path: Sequence[str | int]) -> list[str]:
    """Keys that a model has at a path below it."""
    keys: list[str] = []
    for one in alternatives(annotation):
        if isinstance(one, type) and issubclass(one, BaseModel):
            if not path:
                keys += one.model_fields
            elif field := one.model_fields.get(str(path[0])):
                keys += _keys(field.annotation, path[1:])
        elif path and typing.get_origin(one) in (dict, list, tuple):
            # This part of the path is a key or an index; the last type is that of the values.
            types_ = [type_ for type_ in typing.get_args(one) if type_ is not Ellipsis]
            keys += _keys(types_[-1], path[1:])
    return keys


@dataclass(frozen=True)
class Plugins:
    """Objects of one kind by name: built-in ones, other packages', and ``module:attribute``."""

    kind: str  # in messages, as "odometry"
    ours: Mapping[str, str]  # where the built-in ones are
    error: type[AdaptuneError]  # says that there is none of a name
    group: str = ""  # of entry points, in which installed packages announce theirs
    sort: str = "Class"  # or "function"

    def where(self, name: str) -> str:
        """Where an object is, as ``module:attribute``, without importing it."""
        path = self.ours.get(name) or (name if ":" in name else None)
        if path is None:
            announced = {point.name: point.value for point in entry_points(group=self.group)}
            if name not in announced:
                help_ = f"{nearest(name, [*self.ours, *announced])} (a {self.sort.lower()} of your "
                what = f"there is no {self.kind} {name!r}: {help_}own is module:{self.sort})"
                raise self.error(what)
            path = announced[name]
        module, _, own = path.partition(":")
        if module == "__main__":  # of a notebook; trials run in other processes
            help_ = f"put it into a file, mine.py, and name mine:{own}"
            raise self.error(f"{name}: {own} lives in this session only; {help_}")
        if not all(map(str.isidentifier, module.split("."))):
            help_ = f"write it as Python imports it, as in my_package.my_module:{self.sort}"
            if self.kind == "odometry":
                help_ += "; of images, `docker images` has none of this name"
            raise self.error(f"{name}: {module!r} is not the name of a module; {help_}")
        return path

    def load(self, name: str) -> Any:
        """Import an object."""
        module, _, attribute = self.where(name).partition(":")
        try:
            return getattr(import_module(module), attribute)
        except ImportError as error:
            help_ = "install it, or name its folder in PYTHONPATH"
            raise self.error(f"{name}: cannot import {module} ({error}); {help_}") from error
        except (ConfigurationError, ValidationError) as error:
            raise self.error(f"{name}: cannot import {module} ({in_one_line(error)})") from error
        except AttributeError as error:
            what = f"{module} has no {attribute or self.sort.lower()}"
            raise self.error(f"{name}: {what}") from error

    def derived(self, name: str, base: type, base_name: str) -> type[Any]:
        """Import a class, which may be the user's, that is derived from another one."""
        try:
            found = self.load(name)
        except self.error:
            raise
        except Exception as error:
            raise self.error(f"{name}: cannot be imported: {in_a_line(error)}") from error
        if not (isinstance(found, type) and issubclass(found, base)):
            raise self.error(f"{name}: is not a class derived from {base_name}")
        return found
