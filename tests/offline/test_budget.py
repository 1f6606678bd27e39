import json
import os
import re

import pytest

from offline.config import OfflineConfig, load_study
from offline.objective import Verdict
from offline.search import Clock, has_ended, spent
from offline.train import train


def verdicts(*values):
    return [Verdict({"x": float(i)}, (value,)) for i, value in enumerate(values)]


@pytest.mark.parametrize(
    ("budget", "errors", "hours", "reason"),
    [
        ({"trials": 3}, [1.0, 2.0, 3.0], 0.0, "3 trials are done"),
        ({}, [1.0] * 64, 9.0, "64 trials"),
        ({"hours": 2.0}, [1.0], 2.0, "2.00 hours have passed"),
        ({"stagnation": 3}, [5.0, 2.0, 3.0, 3.0], 0.0, None),
        ({"stagnation": 3}, [5.0, 2.0, 3.0, 3.0, 2.0], 0.0, "none of 3 trials .* than trial 1"),
        ({"sampler": "grid"}, [1.0] * 1000, 0.0, None),
    ],
)
def test_stops_when_the_first_budget_is_used_up(budget, errors, hours, reason):
    best = errors.index(min(errors)) if errors else 0
    found = spent(OfflineConfig(**budget), verdicts(*errors), best, hours, best)
    assert (found is None) == (reason is None)
    assert reason is None or re.search(reason, found)


def test_the_clock_goes_on_counting(tmp_path):
    path = tmp_path / "elapsed.json"
    clock = Clock(path)
    assert clock.hours(5) == 0.0
    with pytest.raises(KeyboardInterrupt), clock.running(0):
        raise KeyboardInterrupt
    with clock.running(1):
        pass
    seconds = json.loads(path.read_text())
    assert set(seconds) == {"0", "1"}
    path.write_text('{"0": 3600, "1": 1800.0, "2": 9}')
    assert Clock(path).hours(2) == 1.5


def trials(folder):
    files = folder.glob("trials/*/*.npz")
    return {f: f.stat().st_mtime_ns for f in files if f.stem.isdigit()}


GRID = (
    "offline.sampler_settings={grid: {max_correspondence_distance: [1.0, 2.0, 2],"
    " keyframe_interval: [1.0, 4.0, 3]}}"
)


def test_a_search_ends_where_its_budget_does_and_again_when_resumed(study_file, tmp_path, caplog):
    caplog.set_level("INFO")
    folder = tmp_path / "run"
    train(load_study(study_file, ["offline.trials=8"], folder))
    before = trials(folder)
    assert len(before) == 2 * 8
    # The trials are there: a budget that ends the search before finds them, and runs none.
    for budget in ("offline.stagnation=1", "offline.hours=1e-9"):
        training = train(load_study(study_file, ["offline.trials=", budget], folder))
        assert len(training.model.sets) in (4, 8)
    assert trials(folder) == before
    assert "the search ends: none of" in caplog.text


def test_a_grid_is_walked_to_its_end(study_file, tmp_path, caplog):
    caplog.set_level("INFO")
    given = ["offline.sampler=grid", GRID, "offline.trials="]
    training = train(load_study(study_file, given, tmp_path / "run"))
    pairs = [tuple(s.values()) for s in training.model.sets.parameters]
    assert pairs[0] == (2.0, 1.0)
    assert pairs[1:] == [(d, k) for d in (1.0, 3.0) for k in (1.0, 5.0, 9.0)]
    assert "the search ends: there is nothing else to try" in caplog.text
    again = train(load_study(study_file, given, tmp_path / "run"))
    assert again.model.sets.parameters == training.model.sets.parameters


def test_a_study_has_ended_when_its_table_is_newer_than_all_trials(tmp_path):
    trial, table = tmp_path / "trials/one/00001.npz", tmp_path / "trials.csv"
    trial.parent.mkdir(parents=True)
    trial.touch()
    assert not has_ended(tmp_path)
    table.touch()
    assert has_ended(tmp_path)
    os.utime(trial, ns=(0, table.stat().st_mtime_ns + 1))
    assert not has_ended(tmp_path)
