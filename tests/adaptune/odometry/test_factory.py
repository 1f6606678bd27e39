import pytest

from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeSettings
from adaptune.odometry.registry import OdometryFactory
from adaptune.odometry.remote import Limits
from adaptune.space import Float, ParameterSpace

SPACE = ParameterSpace({"keyframe_interval": Float(low=1.0, high=9.0, baseline=2.0)})


def factory(name="gicp", settings=None, space=SPACE, **rest):
    return OdometryFactory(name, settings or {}, space, Limits(), **rest)


def test_it_makes_what_the_name_says():
    gicp = factory(settings={"downsampling": 0.3})
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
    assert "small_gicp" in gicp.versions
    assert gicp(isolated=True).usage.memory == 0.0
    with pytest.raises(OdometryError, match="did you mean 'gicp'"):
        _ = factory("gipc").description
