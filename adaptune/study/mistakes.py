"""Mistakes in a study's YAML, each with the path of its key."""

import types
import typing
from collections.abc import Iterable, Sequence
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError

from adaptune.errors import AdaptuneError
from adaptune.plain_words import UNKNOWN, Key, plain_words
from adaptune.space import nearest

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
        for path, message in plain_words(error, data).items():
            said = _unknown(model, path, key) if message == UNKNOWN else message
            mistakes.append(Mistake(key + path, said))
        return None


def validated_rest(
    model: type[M],
    data: dict[str, Any],
    needed: dict[str, Any],
    mistakes: Iterable[Mistake],
    context: dict[str, Any],
) -> M | None:
    """Validate what is left of a section without its mistakes, with `needed` where it lacks keys.

    What is not mistaken by itself may still not go together. None if nothing can be left.
    """
    keys, given = [mistake.key for mistake in mistakes], data
    while (rest := needed | _without(data, keys)) != given:
        found: list[Mistake] = []
        if (valid := validated(model, rest, (), found, context)) is not None:
            return valid
        given = rest
        keys += [mistake.key for mistake in found]
    return None


def _without(data: dict[str, Any], keys: Iterable[Key]) -> dict[str, Any]:
    """Leave out what the keys lead to; where there is no such key, the section that lacks it."""
    rest = {}
    for name, value in data.items():
        below = [key[1:] for key in keys if key[:1] == (name,)]
        if not below:
            rest[name] = value
        elif isinstance(value, dict) and all(key and key[0] in value for key in below):
            rest[name] = _without(value, below)
    return rest


def _unknown(model: type[BaseModel], path: Key, key: Key) -> str:
    if new := RENAMED.get(".".join(map(str, key + path))):
        return f"is now called {new}"
    return f"{UNKNOWN}; {nearest(str(path[-1]), _keys(model, path[:-1]))}"


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
