from dataclasses import replace

from random_models import random_model

from adaptune.model import PairedSettings
from adaptune.study.study import ONE_SET
from offline.train import changes

EXPECTED = {"geometric": 0.8, "low": 0.7, "high": 0.9, "worst_tenth": 1.1}
EXPECTED |= {"n_stretches": 12, "n_recordings": 7}


def test_what_differs_is_said():
    before = replace(random_model(), bank=[], paired=PairedSettings(adapt=False))
    after = replace(
        before,
        sequences=[*before.sequences, "garden"],
        fixed=before.sets.trials[-1],
        paired=PairedSettings(adapt=True),
        expected={ONE_SET: EXPECTED},
    )
    sequences, fixed, driven, expected = changes(before, after)
    assert sequences == "Trained on garden, too."
    assert fixed == f"The fixed set was trial {before.fixed}, is trial {after.fixed}."
    assert driven == "Driven: was the fixed set, is one set at a time."
    assert expected.startswith("Expected before: no gain. Now: expected gain 20 %")
