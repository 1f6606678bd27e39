from collections.abc import Iterator

from pydantic import BaseModel

from adaptune._system.strict import alternatives
from offline.config import OfflineStudyConfig

MOST_KEYS = 45
"""Outside of odometries, sequences and courses."""


def keys(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Every key below a section that has none below it."""
    for name, field in model.model_fields.items():
        types = alternatives(field.annotation)
        if sections := [type_ for type_ in types if isinstance(type_, type(BaseModel))]:
            for section in sections:
                yield from keys(section, f"{prefix}{name}.")
        else:
            yield prefix + name


def test_there_are_no_more_keys_than_a_reader_can_take_in():
    others = ("odometry", "sequences", "courses")
    shared = {key for key in keys(OfflineStudyConfig) if key.split(".")[0] not in others}
    assert 0 < len(shared) <= MOST_KEYS, shared
