import collections
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.space import ODOMETRY, Categorical, Float, Integer, ParameterSpace, PooledSpace
from offline.config import OfflineConfig, Span, load_study, make_grid
from offline.samplers import make_sampler, sobol_points

SPACE = ParameterSpace(
    {
        "distance": Float(low=0.01, high=100.0, baseline=3.0, log=True),
        "gain": Float(low=-1.0, high=1.0, baseline=0.25),
        "rings": Integer(low=1, high=64, baseline=16, log=True),
        "passes": Integer(low=0, high=9, baseline=2),
        # Python takes 1 and True for equal.
        "kernel": Categorical(choices=("huber", "none", 1, True), baseline="huber"),
    }
)
GRID = {
    "distance": {"low": 0.1, "high": 10.0, "count": 5},
    "gain": [-1.0, 0.5, 5],
    "rings": {"low": 1, "high": 64, "count": 7},
    "passes": [0, 3, 4],
}
FINITE = ParameterSpace(
    {
        "passes": Integer(low=1, high=6, baseline=2),
        "kernel": Categorical(choices=("huber", "none", True), baseline="none"),
    }
)
SETTINGS = {
    "grid": {"grid": GRID},
    "annealing": {"chains": 4},
    "annealing, one chain": {"reanneal_best": 5, "steps": {"gain": {"mu": 0.1, "sigma": 0.3}}},
    "random, of a grid": {"grid": GRID},
    "qmc": {"qmc_type": "halton"},
}
SAMPLERS = [
    "random",
    "random, of a grid",
    "grid",
    "tpe",
    "annealing",
    "annealing, one chain",
    "cmaes",
    "nsga2",
    "qmc",
    "optuna.samplers:RandomSampler",
]


def bowl(parameters):
    return (
        abs(math.log10(parameters["distance"]))
        + abs(parameters["gain"])
        + parameters["rings"] / 64
        + abs(parameters["passes"] - 5) / 9
        + (parameters["kernel"] is not True)
    )


@pytest.fixture(params=SAMPLERS)
def config(request):
    settings = SETTINGS.get(request.param, {})
    name = request.param.partition(",")[0]
    return OfflineConfig(sampler=name, sampler_settings=settings, batch=8, initial=12, seed=5)


but_for_the_grid = pytest.mark.parametrize(
    "config", [name for name in SAMPLERS if name != "grid"], indirect=True
)


def run(config, n_batches, space=SPACE, error=bowl):
    sampler = make_sampler(space, config)
    history = []
    for _ in range(n_batches):
        history += [(s, error(s)) for s in sampler.propose(history)]
    return history


def test_sets_are_of_the_space(config):
    history = run(config, 6)
    assert len(history) == 48
    for parameters, _ in history:
        SPACE.check(parameters)
        types = [type(value) for value in parameters.values()]
        assert types[:4] == [float, float, int, int]
        assert list(parameters) == list(SPACE.names)


def test_sets_differ(config):
    sets = [repr(s) for s, _ in run(config, 8)]
    assert len(set(sets)) == len(sets) == 64


@pytest.mark.parametrize("known", [0, 1, 3, 4])
def test_resumes_exactly(config, known):
    history = run(config, 6)
    resumed = make_sampler(SPACE, config)
    for batch in range(known, 6):
        assert resumed.propose(history[: 8 * batch]) == [
            s for s, _ in history[8 * batch : 8 * batch + 8]
        ]


@but_for_the_grid
def test_heeds_the_log_scale(config):
    config = config.model_copy(update={"initial": 48})
    sets = [s for s, _ in run(config, 12, error=lambda _: 1.0)]
    assert 0.2 < np.mean([s["distance"] < 1.0 for s in sets]) < 0.8
    assert 0.2 < np.mean([s["rings"] < 8 for s in sets]) < 0.8


def test_tries_all_there_is_and_ends(config):
    if "grid" in config.sampler_settings:
        settings = {"grid": {"passes": [1, 1, 6]}}
        config = config.model_copy(update={"sampler_settings": settings})
    if "steps" in config.sampler_settings:
        config = config.model_copy(update={"sampler_settings": {}})
    sampler = make_sampler(FINITE, config)
    history = []
    while sets := sampler.propose(history):
        history += [(s, s["passes"] / 6 + (s["kernel"] == "none")) for s in sets]
        if len(sets) < config.batch:
            break
    assert len(history) == 18
    assert max(collections.Counter(repr(s) for s, _ in history).values()) == 1


LEARNING = ["tpe", "annealing", "cmaes", "nsga2"]


@pytest.mark.parametrize("name", LEARNING)
def test_learns(name):
    config = OfflineConfig(sampler=name, batch=8, initial=16, seed=5)
    errors = [error for _, error in run(config, 14)]
    assert np.mean(errors[64:]) < 0.7 * np.mean(errors[1:16])


@pytest.mark.parametrize("name", LEARNING)
def test_begins_with_points_that_spread_evenly_in_ratio(name):
    config = OfflineConfig(sampler=name, batch=64, initial=64, seed=1)
    sets = [s for s, _ in run(config, 1)]
    assert sets[1:] == sobol_points(SPACE, 1, range(1, 64))
    counts, _ = np.histogram(np.log10([s["distance"] for s in sets[1:]]), bins=4, range=(-2, 2))
    assert counts.min() >= 14


@pytest.mark.parametrize("name", ["tpe", "nsga2", "random"])
def test_searches_for_several_objectives(name):
    config = OfflineConfig(sampler=name, objective=["rte", "rpe"], batch=8, initial=16, seed=5)
    history = run(config, 8, error=lambda s: (bowl(s), s["gain"] + 1.0))
    assert len({repr(s) for s, _ in history}) == 64
    assert make_sampler(SPACE, config).propose(history[:40]) == [s for s, _ in history[40:48]]
    if name in LEARNING:
        sums = [sum(values) for _, values in history]
        assert np.mean(sums[40:]) < np.mean(sums[1:16])


CONSTRAINED = ["tpe", "nsga2", "gp"]


@pytest.mark.parametrize("name", [*CONSTRAINED, "annealing", "cmaes"])
def test_keeps_limits(name):
    if name == "gp":
        pytest.importorskip("torch", reason="torch is not installed: pip install 'adaptune[gp]'")
    space = ParameterSpace({n: SPACE.parameters[n] for n in ("distance", "gain")})
    n_batches = 5 if name == "gp" else 10
    config = OfflineConfig(sampler=name, batch=8, initial=16, seed=5)

    def result(s):
        return s, 2.0 + s["gain"], (-s["gain"], s["gain"] - 0.9)

    sampler, history = make_sampler(space, config), []
    for _ in range(n_batches):
        history += [result(s) for s in sampler.propose(history)]
    late = [s["gain"] for s, *_ in history[24:]]
    assert np.mean([gain >= 0.0 for gain in late]) > 0.6
    assert np.mean([0.0 <= gain < 0.45 for gain in late]) > 0.4
    resumed = make_sampler(space, config)
    assert resumed.propose(history[:32]) == [s for s, *_ in history[32:40]]
    # Who knows of constraints is told the truth, others are told of a bad value.
    trials = [t for t in sampler._study.get_trials() if t.values]
    broken = [t for t in trials if t.params["gain"] < 0.0]
    assert broken
    for trial in broken:
        gain = trial.params["gain"]
        if name in CONSTRAINED:
            assert trial.value == 2.0 + gain
            assert trial.constraints == {"0": -gain, "1": gain - 0.9}
        else:
            assert trial.value > 2.0 + gain + 20.0
            assert trial.constraints == {}


def test_ends_when_all_chains_have_stalled():
    settings = {"chains": 2, "stall_accepted": 4}
    config = OfflineConfig(
        sampler="annealing", sampler_settings=settings, batch=4, initial=4, seed=5
    )
    sampler, history = make_sampler(SPACE, config), []
    while sets := sampler.propose(history):
        history += [(s, float(len(history) + i)) for i, s in enumerate(sets)]
        assert len(history) < 500
    assert sampler.end == "all chains have stalled"
    assert make_sampler(SPACE, config).propose(history) == []
    assert len(make_sampler(SPACE, config).propose(history[:-4])) == 4


def test_older_studies_call_qmc_sobol(study_file):
    assert load_study(study_file, ["offline.sampler=sobol"]).config.offline.sampler == "sobol"
    of = [OfflineConfig(sampler=name, batch=8, seed=5) for name in ("qmc", "sobol")]
    one, other = (make_sampler(SPACE, config).propose([]) for config in of)
    assert len(one) == 8
    assert one == other


THREE = ParameterSpace(
    {
        "a": Float(low=0.0, high=10.0, baseline=7.3),
        "b": Integer(low=0, high=100, baseline=50),
        "c": Categorical(choices=("x", "y"), baseline="x"),
    }
)


def walk(name, grid, trials, batch=5, space=THREE, seed=0):
    config = OfflineConfig(sampler=name, sampler_settings={"grid": grid}, batch=batch, seed=seed)
    sampler, history = make_sampler(space, config), []
    while len(history) < trials:
        sets = sampler.propose(history)
        history += [(s, 1.0) for s in sets]
        if len(sets) < batch:
            break
    return [tuple(s.values()) for s, _ in history[:trials]]


def test_a_grid_is_walked_in_row_major_order():
    rows = walk("grid", {"a": [1.0, 0.5, 3], "b": [10, 20, 2]}, 100)
    assert rows[0] == (7.3, 50, "x")
    assert rows[1:] == list(itertools.product((1.0, 1.5, 2.0), (10, 30), ("x", "y")))


def test_the_baseline_is_not_tried_again_where_the_grid_holds_it():
    grid = {"a": [0.1, 0.1, 100], "b": [50, 1, 1], "c": ["x"]}
    rows = walk("grid", grid, 200, batch=7)
    assert len(rows) == 100
    # 0.1 + 72 * 0.1 is not 7.3, but nearly.
    assert sum(abs(a - 7.3) < 1e-6 for a, *_ in rows) == 1
    assert rows[0][0] == 7.3


@pytest.mark.parametrize("batch", [1, 4, 100])
def test_random_draws_from_a_grid_without_repetition(batch):
    grid = {"a": [0.0, 1.0, 11], "b": {"low": 0, "high": 100, "count": 11}}
    rows = walk("random", grid, 500, batch)
    assert len(set(rows)) == len(rows) == 11 * 11 * 2 + 1
    assert rows == walk("random", grid, 500, 9)
    assert rows != walk("random", grid, 500, 9, seed=1)
    assert rows[1:] != sorted(rows[1:])


def test_a_huge_grid_is_drawn_from_without_making_it():
    grid = {"a": [0.0, 1e-4, 100_000], "b": [0, 1, 101]}
    rows = walk("random", grid, 300)
    assert len(set(rows)) == 300
    assert 4.0 < sum(a for a, *_ in rows) / 300 < 6.0


@given(
    st.integers(1, 6), st.integers(1, 6), st.floats(0.0, 4.0), st.floats(0.01, 1.0), st.booleans()
)
def test_index_is_the_inverse(n, m, first, step, log):
    low, high = first + 0.01, first + 0.01 + step * n
    space = ParameterSpace(
        {
            "a": Float(low=0.001, high=20.0, baseline=1.0, log=log),
            "b": Integer(low=0, high=100, baseline=50),
            "c": Categorical(choices=(1, True), baseline=1),
        }
    )
    grid = make_grid(space, {"a": Span(low=low, high=high, count=n), "b": (3, 2, m)})
    assert grid.size == 2 * n * m
    for i in range(grid.size):
        space.check(grid[i])
        assert grid.index(grid[i]) == i
    assert grid.index({"a": 0.001, "b": 3, "c": 1}) is None


POOL = PooledSpace(
    {
        "gicp": ParameterSpace.of(
            distance=Float(low=0.1, high=10.0, baseline=1.0, log=True),
            passes=Integer(low=1, high=40, baseline=20),
        ),
        "ndt": ParameterSpace.of(distance=Float(low=0.5, high=20.0, baseline=4.0, log=True)),
        "kiss": ParameterSpace.of(voxel=Float(low=0.1, high=3.0, baseline=1.0)),
    }
)


def pool_error(parameters):
    if parameters[ODOMETRY] == "gicp":
        return 0.5 + abs(parameters["distance"] - 2.0)
    return 20.0 + (parameters.get("distance") or parameters["voxel"])


def run_pool(pool_config, n_batches, known=()):
    sampler = make_sampler(POOL, pool_config)
    history = list(known)
    for _ in range(n_batches):
        history += [(s, pool_error(s)) for s in sampler.propose(history)]
    return history


@pytest.fixture(params=["tpe", "random"])
def pool_config(request):
    return OfflineConfig(sampler=request.param, batch=8, initial=12, seed=5)


def labels(history):
    return [s[ODOMETRY] for s, _ in history]


def test_the_first_trials_are_the_baselines_and_then_all_take_turns(pool_config):
    history = run_pool(pool_config, 2)
    assert [s for s, _ in history[:3]] == POOL.baselines
    assert labels(history[:8]) == ["gicp", "ndt", "kiss"] * 2 + ["gicp", "ndt"]
    assert min(collections.Counter(labels(history)).values()) >= 4


@pytest.mark.parametrize("known", [0, 1, 3])
def test_a_pool_resumes_exactly(pool_config, known):
    history = run_pool(pool_config, 4)
    assert run_pool(pool_config, 4 - known, history[: 8 * known]) == history


@given(
    n=st.integers(2, 6),
    batch=st.integers(6, 20),
    errors=st.lists(st.floats(0.0, 9.0), min_size=6, max_size=6),
)
def test_batches_are_split_by_rank_and_nobody_is_left_out(n, batch, errors):
    of = {str(i): pool_error for i, pool_error in enumerate(errors[:n])}
    space = PooledSpace(dict.fromkeys(of, POOL.spaces["kiss"]))
    sampler = make_sampler(space, OfflineConfig(sampler="random", batch=batch, initial=batch))
    history = [(s, of[s[ODOMETRY]]) for s in sampler.propose([])]
    proposed = [s[ODOMETRY] for s in sampler.propose(history)]
    counts = collections.Counter(proposed)
    assert counts.total() == batch
    ranked = [counts[label] for label in sorted(of, key=of.__getitem__)]
    assert min(ranked) >= 1
    assert ranked == sorted(ranked, reverse=True)


@pytest.mark.parametrize("batch", [4, 8, 16])
def test_a_finite_pool_is_tried_to_its_end(pool_config, batch):
    few, many = (ParameterSpace.of(n=Integer(low=1, high=n, baseline=1)) for n in (3, 17))
    # Python takes 1 and True for equal.
    equal = ParameterSpace.of(kernel=Categorical(choices=(1, True, "x"), baseline=1))
    space = PooledSpace({"few": few, "many": many, "equal": equal})
    sampler = make_sampler(space, pool_config.model_copy(update={"batch": batch, "initial": 6}))
    history = []
    while sets := sampler.propose(history):
        history += [(s, 1.0) for s in sets]
        if len(sets) < batch:
            break
    assert len(history) == len({repr(s) for s, _ in history}) == 23


def late_sets(limit):
    """The last sets of two alike odometries; a smaller voxel is better."""
    space = PooledSpace(dict.fromkeys(("one", "other"), POOL.spaces["kiss"]))
    sampler, history = make_sampler(space, OfflineConfig(batch=9, initial=18, seed=5)), []
    for _ in range(8):
        history += [(s, s["voxel"], limit(s)) for s in sampler.propose(history)]
    return [s for s, *_ in history[45:]]


def test_sets_that_break_limits_earn_no_share():
    late = late_sets(lambda s: (1.0 if s[ODOMETRY] == "one" else -1.0,))
    assert collections.Counter(s[ODOMETRY] for s in late) == {"one": 9, "other": 18}
