"""Base class of everything that a user sets: its numbers are numbers."""

from collections.abc import Callable
from functools import partial
from typing import Any

from pydantic import BaseModel, ConfigDict, GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

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
