import json
import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from tables import table

from adaptune._system import yaml12
from adaptune.errors import AdaptuneError
from adaptune.space import (
    ODOMETRY,
    Categorical,
    Float,
    Integer,
    ParameterSets,
    ParameterSpace,
    PooledSpace,
    SpaceError,
    load_space,
)

modest = settings(max_examples=60, deadline=None)
unit = st.floats(0.0, 1.0)

SPACE = ParameterSpace(
    {
        "distance": Float(low=0.5, high=8.0, baseline=1.0, log=True),
        "angle": Float(low=-10.0, high=30.0, baseline=0.0),
        "points": Integer(low=2, high=7, baseline=5),
        "kernel": Categorical(choices=("none", "huber", "cauchy"), baseline="none"),
    }
)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (2, 7), (-3, 3)])
def test_integers_have_equal_shares(low, high):
    n = high - low + 1
    parameter = Integer(low=low, high=high, baseline=low)
    middles = (np.arange(120 * n) + 0.5) / (120 * n)
    assert Counter(map(parameter.from_unit, middles)) == dict.fromkeys(range(low, high + 1), 120)
    assert parameter.to_unit(low) == pytest.approx(0.5 / n)


def test_log_scale_is_even_in_ratio():
    parameter = Float(low=0.01, high=100.0, baseline=1.0, log=True)
    values = [parameter.from_unit(u) for u in (0.0, 0.25, 0.5, 0.75, 1.0)]
    assert values == pytest.approx([0.01, 0.1, 1.0, 10.0, 100.0])


@modest
@given(st.integers(2, 12), unit)
def test_choices_have_equal_shares(n, u):
    parameter = Categorical(choices=tuple(range(n)), baseline=0)
    assert parameter.from_unit(u) == min(int(u * n), n - 1)
    for choice in range(n):
        assert parameter.from_unit(parameter.to_unit(choice)) == choice


@pytest.mark.parametrize("u", [-1e9, -0.1, 1.1, 1e9])
def test_beyond_the_unit_interval_is_its_end(u):
    for parameter in SPACE.parameters.values():
        assert parameter.from_unit(u) == parameter.from_unit(float(u > 0))


def test_proposed_values_have_four_digits_or_what_a_narrow_range_needs():
    wide, narrow = Float(low=0.1, high=30.0, baseline=1.0), Float(low=1.0, high=1.01, baseline=1.0)
    assert wide.from_unit(1 / 3) == 10.07
    assert narrow.from_unit(0.123456) == 1.00123
    assert Float(low=0.0, high=1.0, baseline=0.5).from_unit(0.0) == 0.0
    third = Float(low=1 / 3, high=2 / 3, baseline=0.5)
    assert [third.from_unit(u) for u in (0.0, 1.0)] == [1 / 3, 2 / 3]  # the bounds stay


@modest
@given(st.lists(st.tuples(unit, unit, unit, unit), max_size=5))
def test_sets_of_the_unit_cube_are_of_the_space(points):
    points = np.array(points, float).reshape(-1, 4)
    sets = SPACE.from_unit(points)
    for parameters in sets:
        SPACE.check(parameters)
    back = SPACE.to_unit(sets)
    assert back.shape == points.shape
    np.testing.assert_allclose(back[:, :2], points[:, :2], atol=1e-3)
    again = SPACE.from_unit(back)
    for name, kind in [("points", int), ("kernel", str)]:
        assert [parameters[name] for parameters in again] == [p[name] for p in sets]
        assert all(type(p[name]) is kind for p in sets)


@pytest.mark.parametrize(
    ("parameter", "good", "bad"),
    [
        (
            Float(low=1.0, high=2.0, baseline=1.0),
            [1.0, 1.5, 2.0, 1, np.float64(1.2)],
            [0.999, 2.001, math.nan, math.inf, True, "1.5", None],
        ),
        (Integer(low=1, high=3, baseline=1), [1, 2, 3], [0, 4, 2.0, True, "2", None]),
        (
            Categorical(choices=("a", 1, False), baseline="a"),
            ["a", 1, False],
            ["b", True, 0, 1.0, None],
        ),
    ],
    ids=["float", "integer", "categorical"],
)
def test_contains(parameter, good, bad):
    assert [v for v in good if not parameter.contains(v)] == []
    assert [v for v in bad if parameter.contains(v)] == []


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"type": "float", "low": 3, "high": 2, "baseline": 2}, "must be less than"),
        ({"type": "float", "low": 1, "high": 2, "baseline": 2.5}, "must lie between"),
        ({"type": "float", "low": 1, "high": 2, "baseline": math.nan}, "finite"),
        ({"type": "float", "low": 0, "high": 2, "baseline": 1, "log": True}, "above 0"),
        ({"type": "float", "low": 0, "high": math.inf, "baseline": 1}, "finite"),
        ({"type": "float", "low": 0, "high": 2}, "baseline"),
        ({"type": "float", "low": 0, "high": 2, "baseline": 1, "lag": True}, "lag"),
        ({"type": "categorical", "choices": ["a", "a"], "baseline": "a"}, "repeat"),
        ({"type": "categorical", "choices": ["a", "b"], "baseline": "c"}, "not one of"),
    ],
)
def test_bad_parameters_are_refused(data, message):
    with pytest.raises(ValidationError, match=message):
        ParameterSpace.load({"p": data})


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (
            lambda: Float(low=0.1, high=1.0, baseline=5.0),
            "Float(low=0.1, high=1.0, baseline=5.0): baseline (5) must lie between low (0.1) and "
            "high (1)",
        ),
        (
            lambda: Integer(low=1, high=2.5, baseline=1),
            "Integer(low=1, high=2.5, baseline=1): high: give a whole number, not 2.5",
        ),
        (
            lambda: Categorical(choices=("a", "b"), baseline="c"),
            "Categorical(choices=('a', 'b'), baseline='c'): baseline 'c' is not one of the choices",
        ),
    ],
)
def test_bad_parameters_of_code_are_told_in_a_sentence(make, told):
    with pytest.raises(AdaptuneError) as caught:
        make()
    assert str(caught.value) == told


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angel": 1.0}, "unknown parameter 'angel': did you mean 'angle'"),
        ({"angle": 31.0}, r"angle = 31.0 is outside \[-10, 30\]"),
        ({"points": 2.5}, r"points = 2.5 is outside \[2, 7\]"),
        ({"kernel": "tukey"}, "kernel = 'tukey' is outside {'none', 'huber', 'cauchy'}"),
    ],
)
def test_check_says_what_is_wrong(change, message):
    SPACE.check(SPACE.baseline)
    with pytest.raises(SpaceError, match=message):
        SPACE.check(SPACE.baseline | change)


def test_space_survives_its_dump():
    space = ParameterSpace(
        dict(SPACE.parameters) | {"mixed": Categorical(choices=(1, "1", 2.5, True), baseline=2.5)}
    )
    dumped = space.dump()
    for read in (json.loads(json.dumps(dumped)), yaml12.Document(yaml12.dump(dumped)).data):
        back = ParameterSpace.load(read)
        assert back == space
        assert list(map(type, back.parameters["mixed"].choices)) == [int, str, float, bool]


def test_a_unit_is_for_pictures_only():
    distance = Float(low=0.1, high=2.0, baseline=1.0)
    plain = ParameterSpace.of(distance=distance)
    space = ParameterSpace.of(distance=distance.model_copy(update={"unit": "m"}))
    assert (space.labels, plain.labels) == ({"distance": "distance [m]"}, {"distance": "distance"})
    # Trials and models of a study stay those of the study that names no unit.
    assert space == plain
    assert space.dump() == plain.dump()
    assert ParameterSpace.load(space.definition()).labels == space.labels


def test_sets_are_known_by_their_trials():
    sets = table([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]], (0, 4, 7))
    assert list(sets) == [0, 4, 7]
    assert len(sets) == 3
    assert sets[4] == {"p0": 0.3, "p1": 0.4}
    assert 7 in sets
    assert 1 not in sets
    assert sets.column(7) == 2
    assert sets.columns([7, 0]).tolist() == [2, 0]
    np.testing.assert_allclose(sets.unit, [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    few = sets.subset([7, 0])
    assert (few.trials, few[0]) == ((7, 0), {"p0": 0.1, "p1": 0.2})
    np.testing.assert_allclose(few.unit, sets.unit[[2, 0]])


GICP = ParameterSpace.of(
    distance=Float(low=0.1, high=10.0, baseline=1.0, log=True),
    kernel=Categorical(choices=("huber", "none"), baseline="none"),
)
NDT = ParameterSpace.of(
    distance=Float(low=1.0, high=4.0, baseline=2.0), passes=Integer(low=1, high=9, baseline=3)
)
POOLED = PooledSpace({"gicp": GICP, "ndt": NDT})


def sets():
    unit = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2)
    return st.builds(
        lambda label, u: {ODOMETRY: label, **POOLED.spaces[label].from_unit(np.array([u]))[0]},
        st.sampled_from(["gicp", "ndt"]),
        unit,
    )


@given(sets())
def test_a_set_returns_from_the_unit_cube(parameters):
    unit = POOLED.to_unit([parameters])
    assert unit.shape == (1, len(POOLED)) == (1, 6)
    assert 0.0 <= unit.min() <= unit.max() <= 1.0
    (back,) = POOLED.from_unit(unit)
    POOLED.check(back)
    assert back[ODOMETRY] == parameters[ODOMETRY]
    assert back == {k: pytest.approx(v) if k == "distance" else v for k, v in parameters.items()}


def test_it_is_read_as_it_was_written():
    assert load_space(POOLED.dump()) == POOLED
    assert load_space(GICP.dump()) == GICP
    assert not isinstance(load_space(GICP.dump()), PooledSpace)
    # A parameter may be called what a parameter has.
    odd = PooledSpace({"a": ParameterSpace.of(type=Float(low=0.0, high=1.0, baseline=0.5))})
    assert load_space(odd.dump()) == odd


def test_baselines():
    assert POOLED.baseline == {ODOMETRY: "gicp", **GICP.baseline}
    assert POOLED.baselines[1] == {ODOMETRY: "ndt", **NDT.baseline}
    assert POOLED.complete({ODOMETRY: "ndt", "passes": 9})["distance"] == 2.0
    parameters = (POOLED.baselines[1], {ODOMETRY: "ndt", "distance": 3.0, "passes": 3})
    table = ParameterSets(POOLED, (4, 7), parameters)
    assert table.defaults == [4]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"distance": 1.0}, "names no odometry"),
        ({ODOMETRY: "ntd", "distance": 1.0}, "did you mean 'ndt'"),
        ({ODOMETRY: "ndt", "distance": 9.0, "passes": 1}, "is outside"),
    ],
)
def test_sets_that_do_not_fit(wrong, message):
    with pytest.raises(SpaceError, match=message):
        POOLED.check(wrong)
