import datetime
import enum
import re
import uuid
from collections.abc import Callable
from decimal import Decimal
from typing import Annotated, Literal

import pytest
from pydantic import AnyUrl, BaseModel, Field, StringConstraints, TypeAdapter, ValidationError

from adaptune.strict import in_one_line, plain_words


class Colour(enum.Enum):
    RED = "red"


class Settings(BaseModel):
    a: int


TYPES = [
    *(int, float, bool, str, bytes, list, dict, set, tuple, Colour, uuid.UUID, Decimal),
    *(datetime.date, datetime.time, datetime.datetime, datetime.timedelta, AnyUrl, Settings, None),
    *(Literal["a", "b"], Callable, type[int], tuple[int, int], list[int], int | str | None),
    Annotated[str, StringConstraints(min_length=3, max_length=4, pattern="^x")],
    Annotated[int, Field(gt=3, lt=5, multiple_of=2)],
    Annotated[tuple[int, ...], Field(min_length=2, max_length=2)],
]
GIVEN = [None, True, 4, 9, 2.5, "", "y", "yyyyyy", b"x", [], [1, 2, 3], ["a"], {}, {"b": 1}]


@pytest.mark.parametrize("type_", TYPES, ids=str)
def test_nothing_of_pydantic_is_left(type_):
    told = 0
    for given in GIVEN:
        try:
            TypeAdapter(type_).validate_python(given)
        except ValidationError as error:
            for message in (*plain_words(error, given).values(), in_one_line(error)):
                assert not re.search(
                    "pydantic|https://|Input should|validation|Value error", message
                )
                told += 1
    assert told


def test_an_error_in_one_line_names_every_key():
    with pytest.raises(ValidationError) as caught:
        Settings.model_validate({"a": "x", "b": 1})
    assert in_one_line(caught.value, {"a": "x", "b": 1}) == "a: give a whole number, not 'x'"
    assert in_one_line(ValueError("two\n  lines")) == "two lines"
