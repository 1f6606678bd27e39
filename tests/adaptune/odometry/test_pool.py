import pickle

import pytest

from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeNdt, KeyframeSettings
from adaptune.odometry.registry import OdometryFactory, OdometryPool, odometry_class
from adaptune.odometry.remote import Limits
from adaptune.space import ODOMETRY, Float, ParameterSpace, SpaceError


def factory(name, **settings):
    cls = odometry_class(name)
    made = cls.settings_type(**settings)
    return OdometryFactory(name, made, cls.describe(made).space, Limits())


def pool():
    return OdometryPool({"gicp": factory("gicp", downsampling=0.4), "coarse": factory("ndt")})


def test_it_makes_the_odometry_that_the_set_names():
    both = pool()
    gicp = both({ODOMETRY: "gicp", **both.factories["gicp"].space.baseline})
    assert type(gicp.odometry) is KeyframeGicp
    assert gicp.odometry.settings.downsampling == 0.4
    ndt = both({ODOMETRY: "coarse"} | both.factories["coarse"].space.baseline | {"resolution": 2.5})
    assert type(ndt.odometry) is KeyframeNdt
    assert ndt.odometry.parameters["resolution"] == 2.5
    # Without a set, the baseline of the first.
    assert type(both().odometry) is KeyframeGicp
    with pytest.raises(SpaceError, match="there is no odometry 'ndt'"):
        both({ODOMETRY: "ndt"})
    with pytest.raises(OdometryError):
        OdometryPool({"a": factory("gicp").__class__("gipc", {}, both.space, Limits())})


def test_it_pickles():
    both = pool()
    copy = pickle.loads(pickle.dumps(both))
    assert copy.identity == both.identity
    assert copy.space == both.space
    assert copy.space.baselines == both.space.baselines
    assert type(copy(both.space.baselines[1]).odometry) is KeyframeNdt


SPACE = ParameterSpace({"keyframe_interval": Float(low=1.0, high=9.0, baseline=2.0)})


def test_it_makes_what_the_name_says():
    gicp = OdometryFactory("gicp", {"downsampling": 0.3}, SPACE, Limits())
    instance = gicp({"keyframe_interval": 4.0})
    assert isinstance(instance, InProcess)
    odometry = instance.odometry
    assert type(odometry) is KeyframeGicp
    assert odometry.settings == gicp.settings == KeyframeSettings(downsampling=0.3)
    given = {"keyframe_interval": 4.0, "downsampling": 0.3}
    assert odometry.parameters == KeyframeGicp.space.baseline | given
    # The baseline of the study's space, not the odometry's own.
    assert gicp().odometry.parameters["keyframe_interval"] == 2.0
    assert gicp.description == KeyframeGicp.describe(gicp.settings)
    assert gicp.identity == {"name": "gicp", "settings": gicp.settings.model_dump(mode="json")}
    assert "version of small_gicp" in gicp.content
    assert gicp(isolated=True).usage.memory == 0.0
    with pytest.raises(OdometryError, match="did you mean 'gicp'"):
        _ = OdometryFactory("gipc", {}, SPACE, Limits()).description
