import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.space import Categorical, Float, Integer, ParameterSpace
from offline.config import OfflineConfig, Span, check_grid, make_grid
from offline.samplers import make_sampler

SPACE = ParameterSpace(
    {
        "a": Float(low=0.0, high=10.0, baseline=7.3),
        "b": Integer(low=0, high=100, baseline=50),
        "c": Categorical(choices=("x", "y"), baseline="x"),
    }
)


def walk(name, grid, trials, batch=5, space=SPACE, seed=0):
    config = OfflineConfig(sampler=name, sampler_settings={"grid": grid}, batch=batch, seed=seed)
    sampler, sets = make_sampler(space, config), []
    while len(sets) < trials and (proposed := sampler.propose([], sets)) is not None:
        sets.append(proposed.parameters)
    return [tuple(s.values()) for s in sets]


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


def test_a_grid_has_no_more_points_than_can_be_numbered():
    space = ParameterSpace({name: Float(low=0.0, high=1.0, baseline=0.5) for name in "abcd"})
    (mistake,) = check_grid(dict.fromkeys("abcd", Span(low=0.0, high=1.0, count=100_000)), space)
    assert "coarser" in mistake.what


@given(
    st.integers(1, 6),
    st.integers(1, 6),
    st.floats(0.0, 4.0),
    st.floats(0.01, 1.0),
    st.booleans(),
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
