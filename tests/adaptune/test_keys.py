import pytest

from adaptune.study.config import complete
from offline.config import OfflineStudyConfig


@pytest.mark.parametrize(
    ("incomplete", "completed"),
    [
        ("offline.tr", ["offline.trials="]),
        ("offline.sets=", ["offline.sets=shared", "offline.sets=own"]),
        ("offline.sampler=gr", ["offline.sampler=grid"]),
    ],
)
def test_keys_and_values_are_completed(incomplete, completed):
    assert complete(OfflineStudyConfig, incomplete, {"offline.sampler": ["tpe", "grid"]}) == (
        completed
    )


MOST_KEYS = 45
"""Outside of odometries, sequences and courses."""


def test_there_are_no_more_keys_than_a_reader_can_take_in():
    names = [key.rstrip("=") for key in complete(OfflineStudyConfig, "")]
    shared = [n for n in names if n.split(".")[0] not in ("odometry", "sequences", "courses")]
    assert len(shared) <= MOST_KEYS, shared
