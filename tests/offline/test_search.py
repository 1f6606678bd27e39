import csv
import dataclasses
import itertools
import json
import re

import numpy as np
import pytest
from made_trials import Drawn

from adaptune.archive import Archive, Summary
from adaptune.model import ErrorModel
from adaptune.space import Categorical, ParameterSpace
from offline.campaign import Campaign
from offline.config import OfflineConfig, load_study
from offline.search import Clock, Search, spent, survivors
from offline.train import train
from offline.validate import validate

NAMES = ["one", "two", "three"]


@pytest.fixture
def study_of(study_file, tmp_path):
    """A study of three sequences with some settings, in an unused folder or in a given one."""
    numbers = itertools.count()

    def make(folder=None, training=NAMES, **given):
        given = {"trials": 11, "initial": 4, "batch": 4} | given
        pool = given.pop("pool", None)
        overrides = [f"odometry={pool}"] if pool else []
        overrides += [f"offline.{key}={value}" for key, value in given.items()]
        folder = folder or tmp_path / str(next(numbers)) / "study"
        overrides += [f"training=[{', '.join(training)}]", "test=[]"]
        study = load_study(study_file, overrides, folder)
        folder.mkdir(parents=True, exist_ok=True)
        return study

    return make


def error(sequence, parameters):
    """Every sequence has another best distance; the third is the hardest."""
    best = {"one": 0.2, "two": 0.4, "three": 0.8}[sequence]
    off = abs(np.log(parameters.get("max_correspondence_distance", 1.0) / best))
    return (1.0 + off + 0.01 * parameters["keyframe_interval"]) * (
        2.0 if sequence == "three" else 1.0
    )


def run(study):
    pool = Drawn(error)
    archive = Archive(study.folder / "trials")
    return Campaign(study, archive, pool).run(), archive


def sets(archive):
    """All parameter sets in the archive, by sequence and number."""
    return {(name, n): s.parameters for name in NAMES for n, s in archive.finished(name).items()}


SAMPLERS = {
    "tpe": "{}",
    "annealing": "{chains: 1}",
    "optuna.samplers:NSGAIISampler": "{population_size: 4}",
    "optuna.samplers:CmaEsSampler": "{}",
    "random": "{}",
    "grid": "{grid: {max_correspondence_distance: [1, 1, 4], keyframe_interval: [1, 2, 5]}}",
}


POOL = "[{name: gicp}, {name: vgicp}]"


@pytest.mark.parametrize(
    ("sampler", "pool"),
    [*((sampler, None) for sampler in SAMPLERS), ("tpe", POOL), ("random", POOL)],
)
def test_stopped_and_resumed_it_is_the_same(study_of, sampler, pool):
    given = {"sampler": sampler, "sampler_settings": SAMPLERS[sampler], "pool": pool}
    expected, archive = run(study_of(**given))
    # With a smaller budget first...
    fewer = study_of(trials=6, **given)
    run(fewer)
    # ... and some of it lost.
    rng = np.random.default_rng(0)
    trials = sorted(fewer.folder.glob("trials/*/[0-9]*.npz"))
    for path in rng.choice(trials, len(trials) // 3, replace=False):
        path.unlink()
    again, other = run(study_of(fewer.folder, **given))
    assert again == expected
    assert sets(archive).items() <= sets(other).items()


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_sequences_are_added_and_removed(study_of, sampler):
    given = {"sampler": sampler, "sampler_settings": SAMPLERS[sampler]}

    def run_on(names, trials, folder=None):
        study = study_of(folder, trials=trials, training=names, **given)
        pool = Drawn(error)
        verdicts = Campaign(study, Archive(study.folder / "trials"), pool).run()
        return study.folder, verdicts, {(t.sequence, n) for t in pool.tasks for n in t.numbers}

    folder, first, _ = run_on(["two", "one"], 10)
    before = sets(Archive(folder / "trials"))
    _, verdicts, ran = run_on(NAMES, 10, folder)
    after = sets(Archive(folder / "trials"))
    assert before.items() <= after.items()
    assert {name for name, _ in ran} == {"three"}
    assert list(verdicts) == list(first)
    assert all(after["three", n] == before["one", n] for n in verdicts)
    _, fewer, ran = run_on(["three"], 14, folder)
    assert max(fewer) >= max(verdicts)
    _, _, ran = run_on(NAMES, 14, folder)
    everything = sets(Archive(folder / "trials"))
    assert after.items() <= everything.items()
    numbers = {n: str(s) for (_, n), s in everything.items()}
    assert all(str(s) == numbers[n] for (_, n), s in everything.items())
    assert len(set(numbers.values())) == len(numbers)
    assert run_on(NAMES, 14, folder)[2] == set()


def test_verdicts_belong_to_their_trials_where_numbers_are_left_out():
    space = ParameterSpace({"k": Categorical(choices=("a", "b", "c"), baseline="a")})
    config = OfflineConfig(trials=8, initial=2, batch=2)
    finished = {"one": {}}
    # Trial 3 is known from another sequence.
    known = {0: {"k": "a"}, 3: {"k": "b"}}
    search = Search(config, space, ["one"], finished, known)
    while search.begin(0.0):
        for n in search.numbers:
            finished["one"][n] = Summary(search._sets[n], 1.0, 0, 0, 1.0)
        search.close()
    assert {n: v.parameters for n, v in search.done.items()} == {
        n: run.parameters for n, run in finished["one"].items()
    }


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
    found = spent(OfflineConfig(**budget), range(len(errors)), best, hours)
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


def test_what_cannot_win_any_more_is_given_up():
    before = {0: [3.0, 2.0, 2.0, 1.0], 1: [9.0, 9.0, 9.0, 9.0], 2: [0.1, 0.1]}
    assert survivors({4: [7.0, 1.1], 5: [0.0, 0.1]}, before) == [5]
    assert survivors({4: [7.0, 1.1]}, {}) == [4]


def test_what_is_surely_worse_than_the_best_is_given_up():
    rng = np.random.default_rng(0)
    best = rng.uniform(0.5, 1.0, 8)
    before = {0: (best + 1.0).tolist(), 1: best.tolist(), 2: [0.0]}
    batch = {3: (best[:6] + 0.1).tolist(), 4: (best[:6] - 0.1).tolist()}
    assert survivors(batch, before) == [4]
    # Two sequences cannot tell.
    assert survivors({5: (best[:2] + 1.0).tolist()}, before) == [5]


def test_what_a_pruned_trial_has_seen_feeds_the_model(study_file, tmp_path):
    given = ["training=[one, two, three]", "test=[]", "offline.trials=9", "offline.initial=6"]
    given += ["offline.batch=3", "offline.pruning=wilcoxon", "odometry.name=gicp"]
    study = load_study(study_file, given, tmp_path / "study")
    training = train(study)
    archive = Archive(study.folder / "trials")
    seen = [[n in archive.finished(name) for name in study.training] for n in range(9)]
    n_seen = np.sum(seen, axis=1)
    assert (n_seen[:3] == 3).all()
    assert n_seen.min() == 2
    model = ErrorModel.load(study.folder / "model.safetensors")
    for s, (name, row) in enumerate(zip(study.training, np.transpose(seen), strict=True)):
        errors = model.errors[model.sequence == s]
        assert (np.isnan(errors).all(axis=0) == ~row).all()
        assert (np.isnan(errors).any(axis=0) == ~row).all()
        assert [trial[name] is None for trial in training.trials] == (~row).tolist()
    assert n_seen[training.model.fixed] == 3
    rows = list(csv.DictReader((study.folder / "trials.csv").open()))
    assert [row["mean"] == "" for row in rows] == (n_seen < 3).tolist()
    validation = validate(study).validation
    assert len(validation.left_out) == 3
    before = (study.folder / "model.safetensors").read_bytes()

    # Some of it lost, as to a killed driver, and made again.
    for number in (4, 7):
        for name in study.training[:2]:
            archive.trial_path(name, number).unlink(missing_ok=True)
    train(dataclasses.replace(study))
    assert (study.folder / "model.safetensors").read_bytes() == before
    again = Archive(study.folder / "trials")
    assert [[n in again.finished(name) for name in study.training] for n in range(9)] == seen
