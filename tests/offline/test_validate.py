import numpy as np
import pytest

from offline.validate import LeftOut, Validation, baseline_in_words


@pytest.mark.parametrize(
    ("errors", "better"), [((0.5, 0.51), True), ((0.5, 1.0), False), ((1.5, 1.51), False)]
)
def test_the_baseline_is_better_only_where_the_interval_shows_it(errors, better):
    left_out = [
        LeftOut(f"s{i}", {"baseline": np.full(9, e), "fixed": np.ones(9)}, {}, np.empty(0))
        for i, e in enumerate(errors)
    ]
    said = baseline_in_words(Validation(left_out))
    assert " times the error of the sets that are chosen without what is left out, over 2 " in said
    assert said.endswith("): there the baseline is better.") == better
