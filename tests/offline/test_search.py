import itertools
import re
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from clocks import SteppedClock
from made_trials import Drawn

from adaptune.runs.archive import Archive, TrialSummary
from adaptune.space import Categorical, Integer, ParameterSpace
from offline import search
from offline.campaign import FITTING, Campaign, Forecast
from offline.config import OfflineConfig, load_study
from offline.search import Search, Stopwatch
from offline.train import train

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
        judged = Campaign(study, Archive(study.folder / "trials"), pool).run()
        return study.folder, judged, {(t.sequence, n) for t in pool.tasks for n in t.sets}

    folder, first, _ = run_on(["two", "one"], 10)
    before = sets(Archive(folder / "trials"))
    _, judged, ran = run_on(NAMES, 10, folder)
    after = sets(Archive(folder / "trials"))
    assert before.items() <= after.items()
    assert {name for name, _ in ran} == {"three"}
    assert list(judged) == list(first)
    assert all(after["three", n] == before["one", n] for n in judged)
    _, fewer, ran = run_on(["three"], 14, folder)
    assert max(fewer) >= max(judged)
    _, _, ran = run_on(NAMES, 14, folder)
    everything = sets(Archive(folder / "trials"))
    assert after.items() <= everything.items()
    numbers = {n: str(s) for (_, n), s in everything.items()}
    assert all(str(s) == numbers[n] for (_, n), s in everything.items())
    assert len(set(numbers.values())) == len(numbers)
    assert run_on(NAMES, 14, folder)[2] == set()


def summary(parameters, value=1.0, failure=""):
    return TrialSummary(parameters, value, 0, 0, 1.0, failure=failure)


def searched(config, space, errors, hours=0.0, known=None):
    """A search whose trials have these errors, one after the other."""
    finished = {"one": {}}
    search = Search(config, space, finished, known or {})
    while (number := search.begin(hours)) is not None:
        finished["one"][number] = summary(search.sets[number], next(errors))
    return search


LETTERS = ParameterSpace({"k": Categorical(choices=("a", "b", "c"), baseline="a")})
COUNT = ParameterSpace({"k": Integer(low=1, high=1000, baseline=1)})


def test_values_belong_to_their_trials_where_numbers_are_left_out():
    config = OfflineConfig(trials=8, initial=2, batch=2)
    # Trial 3 is known from another sequence.
    known = {0: summary({"k": "a"}), 3: summary({"k": "b"})}
    search = searched(config, LETTERS, itertools.repeat(1.0), known=known)
    assert {n: v.parameters["k"] for n, v in search.done.items()} == {0: "a", 1: "c", 3: "b"}
    assert search.end == "there is nothing else to try"


@pytest.mark.parametrize(
    ("budget", "errors", "hours", "n", "reason"),
    [
        ({"trials": 3}, [1.0] * 3, 0.0, 3, "3 trials are done"),
        ({}, [1.0] * 64, 0.0, 64, "64 trials"),
        ({"hours": 2.0}, [1.0], 2.0, 1, "no more sets fit into the time"),
        ({"stagnation": 3}, [5.0, 2.0, 3.0, 3.0, 2.0], 0.0, 5, "none of 3 trials .* than the best"),
    ],
)
def test_stops_when_the_first_budget_is_used_up(budget, errors, hours, n, reason):
    config = OfflineConfig(sampler="random", batch=1, **budget)
    search = searched(config, COUNT, iter(errors), hours)
    assert len(search.done) == n
    assert re.search(reason, search.end)


def test_a_search_waits_for_the_results_that_the_next_set_follows_from():
    finished, config = {"one": {}}, OfflineConfig(trials=9, batch=3)
    search = Search(config, COUNT, finished, {})
    assert [search.begin(0.0) for _ in range(4)] == [0, 1, 2, None]
    # The last one is done, but not the first.
    finished["one"][2] = summary(search.sets[2])
    assert search.begin(0.0) is None
    finished["one"][0] = summary(search.sets[0])
    assert [search.begin(0.0) for _ in range(2)] == [3, None]
    assert search.end is None


@pytest.mark.parametrize("name", ["tpe", "annealing"])
@pytest.mark.parametrize("trials", [32, None])
def test_a_default_study_asks_its_sampler(name, trials):
    config = OfflineConfig(sampler=name, trials=trials)
    search = searched(config, COUNT, itertools.repeat(1.0))
    sources = Counter(search.sources.values())
    assert sources["baseline"] == 1
    assert sources[name] >= 0.7 * len(search.done)
    # What keeps the baseline's values may have been tried before.
    assert config.n_initial // 2 < sources["sobol"] < config.n_initial


def test_the_clock_goes_on_counting(tmp_path):
    path = tmp_path / "elapsed.json"
    clock = Stopwatch(path)
    clock.save()
    assert 0.0 < Stopwatch(path).hours < 0.1
    path.write_text('{"seconds": 5400.0}')
    assert 1.5 <= Stopwatch(path).hours < 1.6
    path.write_text("damaged")
    assert Stopwatch(path).hours < 0.1


class Slow(Drawn):
    """Takes ten seconds of a clock for a set on a sequence."""

    def __init__(self, clock):
        super().__init__(error)
        self.clock = clock

    def start(self, worker, task):
        super().start(worker, task)
        self.clock.seconds += 10.0 * len(task.sets)


@pytest.mark.parametrize("expected", [15.0, 30.0, 60.0])
def test_no_set_begins_that_would_not_end_in_time(study_of, monkeypatch, expected):
    clock = SteppedClock()
    monkeypatch.setattr(search, "time", SimpleNamespace(monotonic=clock.now))
    study = study_of(trials="", hours=1500 / 3600)
    of_study = Stopwatch(study.folder / "elapsed.json")
    clock.seconds = 100.0  # reading the bags
    given = Archive(study.folder / "trials"), Slow(clock)
    first = Campaign(study, *given, clock=of_study, expected=Forecast(expected, 10.0 * expected))
    judged = first.run()
    n = f"{len(judged)} parameter sets were tried, 1 of them the odometry's own"
    assert first.words == [f"{n}: no more sets fit into the time."]
    assert clock.seconds == 100.0 + 30.0 * len(judged)
    assert 0.8 * 1500.0 <= clock.seconds + 300.0 + FITTING <= 1500.0
    # Nor if the same command, again, finds that one more would fit.
    again_clock = Stopwatch(study.folder / "elapsed.json")
    again = Campaign(study, *given, clock=again_clock, expected=Forecast(1.0, 1.0))
    assert again.run().keys() == judged.keys()


def test_however_short_the_time_the_baseline_is_driven(study_file, tmp_path, caplog):
    caplog.set_level("INFO")
    study = load_study(study_file, ["offline.trials=", "offline.hours=1e-9"], tmp_path / "run")
    training = train(study)
    assert [row["trial"] for row in training.trials] == [training.model.fixed] == [0]
    assert training.words[0].startswith("1 parameter sets were tried")
    assert "the search ends: no more sets fit into the time" in caplog.text
    assert "no other set than the baseline was tried: allow more time" in caplog.messages


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
        assert 4 <= len(training.model.sets) <= 8
    assert trials(folder) == before
    assert "the search ends: none of" in caplog.text
