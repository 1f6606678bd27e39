"""Parts of a sequence, in percent of its duration."""

import re
from typing import Annotated, Any

from pydantic import BeforeValidator

Fractions = tuple[float, float]
"""Where a part begins and ends, as fractions of the duration."""

_PERCENT = re.compile(r"\s*(\d+(?:\.\d+)?)\s*-\s*(\d+(?:\.\d+)?)\s*%\s*")


def read_part(given: Any) -> Fractions:
    """Read ``0-60%``, or two fractions; a ValueError says what is wrong."""
    begin, end = 1.0, 0.0
    if isinstance(given, str) and (match := _PERCENT.fullmatch(given)):
        begin, end = (float(percent) / 100.0 for percent in match.groups())
    elif isinstance(given, list | tuple) and [type(f) for f in given] in ([float] * 2, [int] * 2):
        begin, end = map(float, given)
    if not 0.0 <= begin < end <= 1.0:
        raise ValueError("give a part in percent of the duration, from 0 to 100, as in 0-60%")
    return begin, end


def part_name(name: str, part: Fractions) -> str:
    """Name of a part of a sequence, which may be the name of a file."""
    begin, end = (f"{100.0 * fraction:.10g}" for fraction in part)
    return f"{name}_{begin}-{end}"


Part = Annotated[Fractions, BeforeValidator(read_part)]
