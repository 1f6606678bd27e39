"""The keys of a study's YAML, for the completion of `-o`."""

import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

from pydantic import BaseModel


def complete(
    model: type[BaseModel], incomplete: str, more: Mapping[str, Sequence[str]] | None = None
) -> list[str]:
    """What ``KEY=VALUE`` can become; `more` has values of keys whose type names none."""
    key, equals, _ = incomplete.partition("=")
    keys = {name: (more or {}).get(name, values) for name, values in _keys(model, "")}
    if equals:
        return [t for v in keys.get(key, ()) if (t := f"{key}={v}").startswith(incomplete)]
    return [f"{name}=" for name in keys if name.startswith(incomplete)]


def _keys(model: type[BaseModel], prefix: str) -> Iterator[tuple[str, Sequence[str]]]:
    """Every key below a section that has none below it, and its values if they are listed."""
    for name, field in model.model_fields.items():
        alternatives = list(_alternatives(field.annotation))
        sections = [a for a in alternatives if isinstance(a, type) and issubclass(a, BaseModel)]
        for section in sections:
            yield from _keys(section, f"{prefix}{name}.")
        if not sections:
            yield prefix + name, [value for a in alternatives for value in _values(a)]


def _alternatives(annotation: Any) -> Iterator[Any]:
    """The types of a union, without what is annotated to them."""
    origin = typing.get_origin(annotation)
    if origin is Annotated:
        yield from _alternatives(typing.get_args(annotation)[0])
    elif origin in (typing.Union, types.UnionType):
        for one in typing.get_args(annotation):
            yield from _alternatives(one)
    else:
        yield annotation


def _values(annotation: Any) -> list[str]:
    if annotation is bool:
        return ["true", "false"]
    literal = typing.get_origin(annotation) is typing.Literal
    return [str(value) for value in typing.get_args(annotation)] if literal else []
