import pytest

from adaptune.study.study import expected_in_words

EXPECTED = {
    "loss": -0.2,
    "geometric": 0.68,
    "low": 0.58,
    "high": 0.8,
    "worst_tenth": 1.02,
    "worst": 1.1,
}


@pytest.mark.parametrize(
    ("n_stretches", "n_recordings", "reach"),
    [
        (24, 6, "in other recordings (24 stretches of 6 recordings)"),
        (7, 1, "elsewhere along this recording (7 stretches of one recording)"),
    ],
)
def test_what_is_expected_is_said_in_one_line(n_stretches, n_recordings, reach):
    expected = EXPECTED | {"n_stretches": n_stretches, "n_recordings": n_recordings}
    assert expected_in_words(expected) == (
        "expected gain 32 % (95 % interval 20 to 42 %), in the worst tenth 1.02 times the fixed "
        f"set's error, {reach}"
    )
