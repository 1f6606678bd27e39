import itertools
from functools import partial

import drawn
import numpy as np
import pytest

from adaptune.archive import Archive, Summary
from adaptune.space import Categorical, ParameterSets, ParameterSpace
from offline.campaign import run_batches
from offline.config import OfflineConfig, load_study
from offline.labelled import labelled_data
from offline.objective import best_by_trials
from offline.samplers import make_sampler
from offline.search import Search, owner
from offline.validate import leave_one_out

NAMES = ["one", "two", "three"]


@pytest.fixture
def study_of(study_file, tmp_path):
    """A study of three sequences with some settings, in an unused folder or in a given one."""
    numbers = itertools.count()

    def make(folder=None, training=NAMES, **given):
        given = {"trials": 11, "initial": 4, "batch": 4} | given
        overrides = [f"offline.{key}={value}" for key, value in given.items()]
        folder = folder or tmp_path / str(next(numbers)) / "study"
        overrides += [f"training=[{', '.join(training)}]", "test=[]"]
        study = load_study(study_file, overrides, folder)
        folder.mkdir(parents=True, exist_ok=True)
        return study

    return make


def error(sequence, parameters):
    """Every sequence has another best distance; the third is the hardest."""
    best = {"one": 0.2, "two": 0.4, "three": 0.8}[sequence]
    off = abs(np.log(parameters["max_correspondence_distance"] / best))
    return (1.0 + off + 0.01 * parameters["keyframe_interval"]) * (
        2.0 if sequence == "three" else 1.0
    )


def run(study):
    pool = drawn.Drawn(error)
    archive = Archive(study.folder / "trials")
    verdicts = run_batches(study, archive, pool)
    seen = {
        n: [name for name in NAMES if n in archive.finished(name)]
        for n in sorted(set().union(*(archive.finished(name) for name in NAMES)))
    }
    return verdicts, seen, archive


def owner_of(archive, number):
    return owner(archive.slots(), number)


def sets(archive):
    """All parameter sets in the archive, by sequence and number."""
    return {(name, n): s.parameters for name in NAMES for n, s in archive.finished(name).items()}


def test_each_sequence_searches_for_itself(study_of):
    study = study_of(sets="own")
    verdicts, seen, archive = run(study)
    numbers = [0, *(100_000 * slot + i for slot in (1, 2, 3) for i in range(1, 11))]
    assert list(verdicts) == list(seen) == numbers
    best = {}
    for name in NAMES:
        of = archive.finished(name)
        mine = [n for n in seen if owner_of(archive, n) in (name, None)]
        assert len(mine) == 11
        best[name] = min(mine, key=lambda n: (of[n].mean_error, n))
    for n, names in seen.items():
        everywhere = n == 0 or n in best.values()
        assert names == (NAMES if everywhere else [owner_of(archive, n)])
        assert verdicts[n].complete == everywhere
        assert list(verdicts[n].sequences) == names
    fixed = best_by_trials(study.config.offline, verdicts)
    assert fixed in {0, *best.values()}
    means = {
        n: np.mean([archive.finished(name)[n].mean_error for name in NAMES]) for n in (0, fixed)
    }
    assert verdicts[fixed].values == pytest.approx((means[fixed],))
    assert means[fixed] < means[0]
    # The searches differ from each other, in their initial points too.
    assert (
        len({str(archive.finished(owner_of(archive, n))[n].parameters) for n in numbers[1:]}) == 30
    )


SAMPLERS = {
    "tpe": "{}",
    "annealing": "{chains: 1}",
    "nsga2": "{}",
    "cmaes": "{}",
    "qmc": "{}",
    "random": "{}",
    "grid": "{grid: {max_correspondence_distance: [1, 1, 4], keyframe_interval: [1, 2, 5]}}",
}


@pytest.mark.parametrize(
    ("sampler", "kind"), [("tpe", "shared"), *((sampler, "own") for sampler in SAMPLERS)]
)
def test_stopped_and_resumed_it_is_the_same(study_of, sampler, kind):
    given = {"sets": kind, "sampler": sampler, "sampler_settings": SAMPLERS[sampler]}
    expected, _, archive = run(study_of(**given))
    # With a smaller budget first, which has other sets run everywhere...
    fewer = study_of(trials=6, **given)
    run(fewer)
    # ... and some of it lost.
    rng = np.random.default_rng(0)
    trials = sorted(fewer.folder.glob("trials/*/[0-9]*.npz"))
    for path in rng.choice(trials, len(trials) // 3, replace=False):
        path.unlink()
    again, _, other = run(study_of(fewer.folder, **given))
    assert again == expected
    assert sets(archive).items() <= sets(other).items()


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("kind", ["shared", "own"])
def test_sequences_are_added_and_removed(study_of, sampler, kind):
    given = {"sets": kind, "sampler": sampler, "sampler_settings": SAMPLERS[sampler]}

    def run_on(names, trials, folder=None):
        study = study_of(folder, trials=trials, training=names, **given)
        pool = drawn.Drawn(error)
        verdicts = run_batches(study, Archive(study.folder / "trials"), pool)
        return study.folder, verdicts, {(t.sequence, n) for t in pool.tasks for n in t.numbers}

    folder, first, _ = run_on(["two", "one"], 10)
    before = sets(Archive(folder / "trials"))
    _, verdicts, ran = run_on(NAMES, 10, folder)
    after = sets(Archive(folder / "trials"))
    assert before.items() <= after.items()
    new = {(name, n) for name, n in ran if name != "three" and n < 300_000}
    # Only the best set of each sequence may be another one now, and runs everywhere.
    assert new <= ({(n, t) for n in NAMES for t in verdicts} if kind == "own" else set())
    shared = [n for n in verdicts if n < 100_000]
    assert shared == [n for n in first if n < 100_000]
    assert all(after["three", n] == before["one", n] for n in shared)
    _, fewer, ran = run_on(["three"], 14, folder)
    assert max(n for n in fewer if n < 100_000) >= max(shared)
    _, _, ran = run_on(NAMES, 14, folder)
    everything = sets(Archive(folder / "trials"))
    assert after.items() <= everything.items()
    numbers = {n: str(s) for (_, n), s in everything.items()}
    assert all(str(s) == numbers[n] for (_, n), s in everything.items())
    of_search = [text for n, text in numbers.items() if n < 100_000]
    assert len(set(of_search)) == len(of_search)
    assert run_on(NAMES, 14, folder)[2] == set()


def test_what_a_place_has_found_is_not_known_where_it_is_left_out(study_of):
    study = study_of(sets="own")
    verdicts, _, archive = run(study)
    sets = ParameterSets(
        study.odometry.space, tuple(verdicts), tuple(v.parameters for v in verdicts.values())
    )
    seen = {name: [n for n, v in verdicts.items() if name in v.sequences] for name in NAMES}
    data = labelled_data(
        archive,
        seen,
        sets,
        study.config,
        study.window,
        study.sequences.recorded_in,
        study.odometry,
    )
    assert np.isnan(data.sequences[0].errors).any()
    complete = data.complete()
    assert list(complete.sets) == [n for n, v in verdicts.items() if v.complete]
    assert complete.fixed() == best_by_trials(study.config.offline, verdicts)
    for sequence in complete.sequences:
        assert sequence.own.tolist() == [
            owner_of(archive, n) == sequence.name for n in complete.sets
        ]
    # These trials have errors without motions.
    validation = leave_one_out(complete, bank=0)
    for left_out in validation.left_out:
        known = [
            archive.finished(left_out.name)[n].mean_error
            for n in complete.sets
            if owner_of(archive, n) != left_out.name
        ]
        assert left_out.errors["oracle, sequence"].mean() == pytest.approx(min(known), rel=1e-5)


def test_verdicts_belong_to_their_trials_where_numbers_are_left_out():
    space = ParameterSpace({"k": Categorical(choices=("a", "b", "c"), baseline="a")})
    config = OfflineConfig(trials=8, initial=2, batch=2)
    finished = {"one": {}}
    # Trial 100003 is known from another sequence.
    known = {0: {"k": "a"}, 100003: {"k": "b"}}
    sampler = partial(make_sampler, space, config)
    search = Search(sampler, config, ["one"], finished, known, 1)
    while search.begin(0.0):
        for n in search.numbers:
            finished["one"][n] = Summary(search.parameters(n), 1.0, 0, 0, 1.0)
        search.close()
    assert {n: v.parameters for n, v in search.done.items()} == {
        n: run.parameters for n, run in finished["one"].items()
    }
