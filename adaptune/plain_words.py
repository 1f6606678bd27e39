"""What pydantic finds wrong, in plain words."""

import json
import re
from collections.abc import Sequence
from typing import Any

from pydantic import ValidationError

Key = tuple[str | int, ...]
"""Keys and indices that lead to a value."""

UNKNOWN = "unknown key"

_LONGEST = 60
"""Characters of a value that a message quotes."""

_NUMBER, _WHOLE, _LIST, _MAPPING = "a number", "a whole number", "a list", "keys with values"
_WANTED = {
    **dict.fromkeys(("float_type", "float_parsing"), _NUMBER),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), _WHOLE),
    "finite_number": "a finite number",
    "string_type": "text",
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
    **dict.fromkeys(("tuple_type", "list_type", "set_type", "frozen_set_type"), _LIST),
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type", "mapping_type"), _MAPPING),
    "none_required": "nothing",
    "greater_than": "a number above {gt}",
    "greater_than_equal": "a number of at least {ge}",
    "less_than": "a number below {lt}",
    "less_than_equal": "a number of at most {le}",
    "too_short": "at least {min_length}",
    "too_long": "at most {max_length}",
    "string_too_short": "at least {min_length} characters",
    "string_too_long": "at most {max_length} characters",
    "literal_error": "{expected}",
}
"""What to give, by pydantic's type of a mistake."""
_OF_VALUES = {kind for kind, wanted in _WANTED.items() if "{" in wanted}


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
    said = plain_words(error, data).items()
    return "; ".join(": ".join(filter(None, (".".join(map(str, key)), text))) for key, text in said)


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
        if detail["type"] not in _WANTED:
            return _plain(str(detail["msg"]))
    # A value of the right type comes nearest.
    nearest = [detail for detail in details if detail["type"] in _OF_VALUES] or list(details)
    wanted = [_wanted(detail) for detail in nearest]
    if _NUMBER in wanted and _WHOLE in wanted:
        wanted.remove(_WHOLE)
    return f"give {' or '.join(dict.fromkeys(wanted))}, not {_given(nearest[0])}"


def _wanted(detail: Any) -> str:
    figures = {
        name: f"{value:,}" if isinstance(value, int) else f"{value:g}"
        for name, value in detail.get("ctx", {}).items()
        if isinstance(value, int | float)
    }
    if detail["type"] == "literal_error":
        return str(detail["ctx"]["expected"]).replace("True", "true").replace("False", "false")
    if detail["type"] == "too_short" and figures["min_length"] == "1":
        return "at least one"
    return _WANTED[detail["type"]].format(**figures)


def _given(detail: Any) -> str:
    """A value in few words, as YAML has it."""
    value = detail["input"]
    if detail["type"] in ("too_short", "too_long"):
        return f"{len(value):,}" if len(value) else "none"
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return _MAPPING
    if isinstance(value, list | tuple):
        return _LIST
    text = repr(value) if isinstance(value, str) else json.dumps(value, default=str)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


def _plain(message: str) -> str:
    """What a class of the user, or a rule of ours, says of a value, without pydantic's words."""
    message = re.sub(r"^(Value error|Assertion failed), ", "", message)
    message = re.sub(r"\b[Ii]nput should be\b", "give", message)
    return re.sub(r" (after|during) validation", "", message).replace("Input should", "it should")
