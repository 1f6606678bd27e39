import pickle
import sys

import numpy as np
import pytest
from needs import needs_evalio

from adaptune.odometry import OdometryError
from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp, KeyframeSettings
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.registry import OdometryFactory
from adaptune.odometry.remote import Limits
from adaptune.recording import Scan
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


def test_what_is_not_tuned_keeps_its_setting_in_another_process():
    needs_evalio()
    settings = {"parameters": {"num_keyframes": 16}}
    space = ParameterSpace({"b_max": Float(low=0.05, high=1.0, baseline=0.2)})
    assert factory("mad_icp", settings, space)().parameters == {"b_max": 0.2}


def test_it_pickles_with_and_without_what_it_has_looked_up():
    gicp = factory(settings={"downsampling": 0.3})
    for _ in range(2):  # The second time with its class and description.
        copy = pickle.loads(pickle.dumps(gicp))
        assert copy.identity == gicp.identity
        assert copy.description == gicp.description
        assert copy({"keyframe_interval": 3.0}).odometry.parameters["keyframe_interval"] == 3.0


def test_a_program_that_fails_is_a_fault(tmp_path):
    asked = []

    def program_input(name):
        asked.append(name)
        return ProgramInput(tmp_path, "/points", "", np.arange(3, dtype=np.int64), None)

    command = factory(
        "command",
        {"command": [sys.executable, "-c", "raise SystemExit(3)"]},
        ParameterSpace({"x": Float(low=0.0, high=1.0, baseline=0.5)}),
        program_input=program_input,
    )
    instance = command({"x": 0.7}, "one")
    scan = instance.prepare(Scan(0, np.zeros((0, 3), np.float32)))
    instance.start(scan, np.eye(4))
    assert "ended with code 3" in instance.faults[0]
    assert asked == ["one"]
