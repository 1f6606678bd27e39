"""Random damage; `python tests/support/fuzz.py` does more of it."""

import fuzz


def test_damaged_messages_give_scans_or_an_error():
    counts = fuzz.fuzz_messages(600, seed=1)
    assert min(counts["scans"], counts["errors"]) > 100


def test_damaged_bags_give_scans_or_an_error(tmp_path):
    counts = fuzz.fuzz_bags(50, 1, tmp_path)
    assert min(counts["scans"], counts["errors"]) > 5
