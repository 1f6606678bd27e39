"""Mistakes in a study's YAML, each with the path of its key."""

import json
import types
import typing
from collections.abc import Sequence
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from adaptune.errors import AdaptuneError
from adaptune.space import nearest

Key = tuple[str | int, ...]
"""Keys and indices that lead to a value."""

RENAMED = {"online.switching.beside": "online.switching.catch_up_scans"}
"""Keys of earlier versions, and their present names."""

M = TypeVar("M", bound=BaseModel)


class ConfigurationError(AdaptuneError):
    """One or more mistakes in a study's YAML, a line each."""


class Mistake(NamedTuple):
    """What is wrong with a value, and what to do; the key of the whole study is empty."""

    key: Key
    message: str

    def below(self, key: Key) -> "Mistake":
        """The mistake as seen from outside the section at `key`."""
        return Mistake(key + self.key, self.message)


def validated(
    model: type[M],
    data: Any,
    key: Key,
    mistakes: list[Mistake],
    context: dict[str, Any] | None = None,
) -> M | None:
    """Validate a section; None if it has mistakes, which are added to `mistakes`."""
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        found: dict[Key, Mistake] = {}
        for detail in error.errors(include_url=False):
            # Where several types are allowed, pydantic names each of them in the path.
            types_ = [part for part in detail["loc"] if isinstance(part, str) and "[" in part]
            path = tuple(part for part in detail["loc"] if part not in types_)
            if not (types_ and path in found):
                found[path] = Mistake(key + path, _message(model, path, key, detail))
                mistakes.append(found[path])
        return None


def _message(model: type[BaseModel], path: Key, key: Key, detail: Any) -> str:
    message = str(detail["msg"]).removeprefix("Value error, ")
    given = json.dumps(detail["input"], default=str)
    if detail["type"] == "extra_forbidden":
        if new := RENAMED.get(".".join(map(str, key + path))):
            return f"is now called {new}"
        return f"unknown key; {nearest(str(path[-1]), _keys(model, path[:-1]))}"
    if detail["type"] == "missing":
        return "this key is missing"
    if detail["type"] == "tuple_type":
        return f"give a list, not {given}"
    if isinstance(detail["input"], dict | list) or detail["type"] == "value_error":
        return message
    return f"{message}, not {given}"


def _keys(annotation: Any, path: Sequence[str | int]) -> list[str]:
    """Keys that a model has at a path below it."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        if not path:
            return list(annotation.model_fields)
        field = annotation.model_fields.get(str(path[0]))
        return _keys(field.annotation, path[1:]) if field else []
    arguments = typing.get_args(annotation)
    if typing.get_origin(annotation) in (dict, list, tuple) and path:
        # This part of the path is a key or an index; the last argument is the type of the values.
        return _keys(next(a for a in reversed(arguments) if a is not Ellipsis), path[1:])
    unions = (types.UnionType, typing.Union, Annotated)
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) in unions:
        return [key for a in arguments for key in _keys(a, path)]
    return []
