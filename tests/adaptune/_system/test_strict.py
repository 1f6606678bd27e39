from typing import Annotated

import pytest
from pydantic import BaseModel, Field, ValidationError

from adaptune._system.strict import StrictModel, in_one_line, plain_words
from adaptune.odometry.registry import ODOMETRIES, PROGRAMS, odometry_class
from adaptune.space import Value
from offline.config import SETTINGS, OfflineStudyConfig


class Inner(StrictModel):
    n: int = 1


class Outer(StrictModel):
    x: float | None = None
    n: Annotated[int, Field(ge=1)] = 1
    yes: bool = False
    pairs: tuple[tuple[float, float], ...] = ()
    by_name: dict[str, Annotated[float, Field(gt=0)]] = Field(default_factory=dict)
    inner: Inner | int = Inner()
    values: tuple[Value, ...] = ()


@pytest.mark.parametrize(
    ("given", "key", "message"),
    [
        ({"x": 1e101}, ("x",), "give a number of at most 1e+100, not 1e+101"),
        ({"n": False}, ("n",), "give a whole number, not false"),
        ({"n": 1.5}, ("n",), "give a whole number, not 1.5"),
        ({"inner": {"n": True}}, ("inner", "n"), "give a whole number, not true"),
        ({"values": [1e300]}, ("values", 0), "give a number of at most 1e+100, not 1e+300"),
    ],
)
def test_what_is_no_number_is_refused(given, key, message):
    with pytest.raises(ValidationError) as caught:
        Outer.model_validate(given)
    ((found, words),) = plain_words(caught.value, given).items()
    assert found == key
    assert words.startswith(message)


def unbounded(schema, definitions, path=""):
    """Paths of numbers in a JSON schema that may be arbitrarily large or small."""
    if "$ref" in schema:
        schema = definitions[schema["$ref"].rpartition("/")[2]]
    choices = schema.get("anyOf", ())
    if {"type": "boolean"} in choices:
        return  # any value of a parameter
    if schema.get("type") in ("integer", "number") and "enum" not in schema:
        bounded = {"minimum", "exclusiveMinimum"} & schema.keys()
        if not (bounded and {"maximum", "exclusiveMaximum"} & schema.keys()):
            yield path
    below = {**schema.get("properties", {}), **dict(enumerate(choices))}
    for key in ("items", "additionalProperties"):
        if isinstance(schema.get(key), dict):
            below[key] = schema[key]
    below |= {f"item {i}": item for i, item in enumerate(schema.get("prefixItems", ()))}
    for key, value in below.items():
        if key not in ("extrinsic", "part", "transform", "transforms"):  # have a check of their own
            yield from unbounded(value, definitions, f"{path}.{key}")


@pytest.mark.parametrize(
    "model",
    [
        OfflineStudyConfig,
        *(odometry_class(name).settings_type for name in (*ODOMETRIES, *PROGRAMS)),
    ],
)
def test_every_number_of_a_study_has_bounds(model):
    schema = model.model_json_schema()
    assert list(unbounded(schema, schema.get("$defs", {}))) == []


@pytest.mark.parametrize("name", SETTINGS)
def test_every_count_of_a_sampler_has_bounds(name):
    schema = SETTINGS[name].model_json_schema()
    counts = {"chains", "count", "delta_max", "stall_best"}
    found = [path.split(".") for path in unbounded(schema, schema.get("$defs", {}))]
    assert not [path for path in found if counts & set(path)]


class Settings(BaseModel):
    a: int


def test_an_error_in_one_line_names_every_key():
    with pytest.raises(ValidationError) as caught:
        Settings.model_validate({"a": "x", "b": 1})
    assert in_one_line(caught.value, {"a": "x", "b": 1}) == "a: give a whole number, not 'x'"
    assert in_one_line(ValueError("two\n  lines")) == "two lines"
