import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

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

GICP = ParameterSpace.of(
    distance=Float(low=0.1, high=10.0, baseline=1.0, log=True),
    kernel=Categorical(choices=("huber", "none"), baseline="none"),
)
NDT = ParameterSpace.of(
    distance=Float(low=1.0, high=4.0, baseline=2.0), passes=Integer(low=1, high=9, baseline=3)
)
SPACE = PooledSpace({"gicp": GICP, "ndt": NDT})


def sets():
    unit = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=2)
    return st.builds(
        lambda label, u: {ODOMETRY: label, **SPACE.spaces[label].from_unit(np.array([u]))[0]},
        st.sampled_from(["gicp", "ndt"]),
        unit,
    )


@given(sets())
def test_a_set_returns_from_the_unit_cube(parameters):
    unit = SPACE.to_unit([parameters])
    assert unit.shape == (1, len(SPACE)) == (1, 6)
    assert 0.0 <= unit.min() <= unit.max() <= 1.0
    (back,) = SPACE.from_unit(unit)
    SPACE.check(back)
    assert back[ODOMETRY] == parameters[ODOMETRY]
    assert back == {k: pytest.approx(v) if k == "distance" else v for k, v in parameters.items()}


def test_it_is_read_as_it_was_written():
    assert load_space(SPACE.dump()) == SPACE
    assert load_space(GICP.dump()) == GICP
    assert not isinstance(load_space(GICP.dump()), PooledSpace)
    # A parameter may be called what a parameter has.
    odd = PooledSpace({"a": ParameterSpace.of(type=Float(low=0.0, high=1.0, baseline=0.5))})
    assert load_space(odd.dump()) == odd


def test_baselines():
    assert SPACE.baseline == {ODOMETRY: "gicp", **GICP.baseline}
    assert SPACE.baselines[1] == {ODOMETRY: "ndt", **NDT.baseline}
    assert SPACE.complete({ODOMETRY: "ndt", "passes": 9})["distance"] == 2.0
    parameters = (SPACE.baselines[1], {ODOMETRY: "ndt", "distance": 3.0, "passes": 3})
    table = ParameterSets(SPACE, (4, 7), parameters)
    assert table.defaults == [4]
    assert table.find({ODOMETRY: "ndt", "distance": 3.0}) == 7


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
        SPACE.check(wrong)
