"""Searches for sets that add to a bank, and among several odometries."""

from functools import partial

import drawn
import numpy as np
import pytest
from drives import STUDY

from adaptune.archive import Archive, Summary
from adaptune.errors import ConfigurationError
from adaptune.space import ODOMETRY, Float, ParameterSpace, PooledSpace
from offline.campaign import run_batches
from offline.config import OfflineConfig, load_study
from offline.samplers import make_sampler
from offline.search import Search

NAMES = ["one", "two", "three"]


class Drifting(drawn.Drawn):
    """Workers whose trials drive along x, and drift to one side by so many percent."""

    def wait(self):
        sequence = self.tasks[-1].sequence
        ((worker, result),) = super().wait()
        T_ref_sensor = np.tile(np.eye(4), (drawn.N_FRAMES, 1, 1))
        T_ref_sensor[:, 0, 3] = 0.5 * np.arange(drawn.N_FRAMES)
        if result.frames is not None:
            result.frames.T_ref_sensor[:] = T_ref_sensor
        for trial in result.trials:
            drift = self.error(sequence, trial.parameters)
            trial.T_odom_sensor[:] = T_ref_sensor
            trial.T_odom_sensor[:, 1, 3] = 0.01 * drift * T_ref_sensor[:, 0, 3]
            trial.errors[:] = abs(drift)
        return [(worker, result)]


def drift(sequence, parameters):
    """By some parameter of the set, and for each odometry to another side."""
    first = next(value for name, value in parameters.items() if name != ODOMETRY)
    best = {"one": 0.9, "two": 1.0, "three": 1.2}[sequence]
    side = 1.5 if parameters.get(ODOMETRY, "gicp") == "gicp" else -1.2
    return side * (0.5 + abs(np.log(first / best)))


SEVERAL = """\
odometry:
  - {name: gicp, settings: {downsampling: 0.5}}
  - {name: vgicp, settings: {downsampling: 0.5}}
"""


@pytest.fixture
def study_of(study_file, tmp_path):
    """A study of one odometry or of two, in a folder of a given name."""

    def load(folder, several=False, **given):
        path = study_file
        if several:
            rest = STUDY[STUDY.index("sequences:") :]
            path = tmp_path / "several.yaml"
            path.write_text(SEVERAL + rest.replace("bag: ", f"bag: {study_file.parent}/"))
        given = {"trials": 32, "initial": 8, "batch": 8} | given
        overrides = [f"offline.{key}={value}" for key, value in given.items()]
        overrides += [f"training=[{', '.join(NAMES)}]", "test=[]"]
        study = load_study(path, overrides, tmp_path / folder)
        study.folder.mkdir(exist_ok=True)
        return study

    return load


def run(study):
    archive = Archive(study.folder / "trials")
    verdicts = run_batches(study, archive, Drifting(drift))
    return verdicts, {n: verdict.parameters for n, verdict in verdicts.items()}


@pytest.mark.parametrize(
    ("several", "given"),
    [
        (False, {"search": "bank"}),
        (False, {"search": "bank", "sets": "both"}),
        (False, {"search": "bank", "pruning": "halving"}),
        (True, {}),
        (True, {"sampler": "sobol"}),
    ],
)
def test_stopped_and_resumed_it_is_the_same(study_of, several, given):
    expected, _ = run(study_of("at-once", several, **given))
    stopped = study_of("stopped", several, **(given | {"trials": 20}))
    run(stopped)
    rng = np.random.default_rng(0)
    trials = sorted(stopped.folder.glob("trials/*/[0-9]*.npz"))
    for path in rng.choice(trials, len(trials) // 3, replace=False):
        path.unlink()
    again, _ = run(study_of("stopped", several, **given))
    assert again == expected


def test_it_looks_elsewhere_than_a_search_for_a_set(study_of):
    (_, bank), (_, alone) = (run(study_of(kind, search=kind)) for kind in ("bank", "set"))
    first = range(8)
    assert [bank[n] for n in first] == [alone[n] for n in first]
    assert bank != alone
    assert len({repr(s) for s in bank.values()}) == 32


def test_among_several_odometries(study_of):
    study = study_of("several", several=True)
    verdicts, sets = run(study)
    assert [sets[0], sets[1]] == study.odometry.space.baselines
    for parameters in sets.values():
        study.odometry.space.check(parameters)
    for first in (8, 16, 24):
        batch = [sets[n][ODOMETRY] for n in range(first, first + 8)]
        assert min(batch.count("gicp"), batch.count("vgicp")) >= 2
    assert all(verdict.complete for verdict in verdicts.values())


def test_what_is_searched_for_lasts(study_of):
    study = study_of("lasting", search="bank", trials=1)
    study.open()
    run(study)
    with pytest.raises(ConfigurationError, match=r"other values of offline\.search"):
        study_of("lasting", search="set").check()


class Named:
    """A sampler that proposes by what it is told: nothing, what sets add, or their errors."""

    end = "never"

    def __init__(self, of_bank, alone):
        self._sets = {None: [0.91, 0.92, 0.93, 0.94], ADDED: of_bank, 1.0: alone}

    def propose(self, results):
        (told,) = {result.value for result in results} or {None}
        return [{"x": x} for x in self._sets[told]]


ADDED = -1.0


@pytest.mark.parametrize("best", range(4))
def test_the_best_of_several_earns_most_wherever_it_is_listed(best):
    one = ParameterSpace.of(x=Float(low=0.0, high=1.0, baseline=0.5))
    space = PooledSpace({str(i): one for i in range(4)})
    config = OfflineConfig(initial=8, batch=8, search="bank", trials=40, sampler="tpe")
    finished = {"one": {}}

    def value(parameters, at):
        return abs(int(parameters[ODOMETRY]) - best) + abs(parameters["x"] - at)

    def portfolio(trials):
        return [value(finished["one"][trial].parameters, 0.2) for trial in trials]

    sampler = partial(make_sampler, space, config)
    search = Search(sampler, config, ["one"], finished, {}, portfolio=portfolio)
    while search.begin(0.0):
        for n in search.numbers:
            own = search.parameters(n)
            finished["one"][n] = Summary(own, value(own, 0.8), 0, 0, 1.0)
        search.close()
    late = [finished["one"][n].parameters[ODOMETRY] for n in range(8, 40)]
    counts = [late.count(str(i)) for i in range(4)]
    assert min(counts) >= 4
    assert counts[best] == max(counts)


@pytest.mark.parametrize(
    ("of_bank", "alone", "expected"),
    [
        ([0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8], [0.1, 0.5, 0.2, 0.6]),
        # What both propose runs once.
        ([0.1, 0.2, 0.3, 0.4], [0.1, 0.2, 0.7, 0.8], [0.1, 0.2, 0.3, 0.7]),
        # Where little is left, the batch is short.
        ([0.1, 0.2], [0.2, 0.1], [0.1, 0.2]),
    ],
)
def test_half_of_a_batch_is_for_the_bank(of_bank, alone, expected):
    config = OfflineConfig(initial=4, batch=4, search="bank", trials=8)
    finished = {"one": {}}
    sampler, portfolio = Named(of_bank, alone), lambda trials: [ADDED] * len(trials)
    search = Search(lambda: sampler, config, ["one"], finished, {}, portfolio=portfolio)
    for wanted in ([0.91, 0.92, 0.93, 0.94], expected):
        assert search.begin(0.0)
        assert [search.parameters(n)["x"] for n in search.numbers] == wanted
        for n in search.numbers:
            finished["one"][n] = Summary(search.parameters(n), 1.0, 0, 0, 1.0)
        search.close()
