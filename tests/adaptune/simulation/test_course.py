import numpy as np
import pytest
from pydantic import ValidationError

from adaptune.simulation import SENSORS, Course
from adaptune.simulation.course import directions


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"scenes": ["moon"]}, "no scene 'moon'; choose from cave, corridor, garden"),
        ({"scenes": ["cave"], "length": 0}, "greater than or equal to 10"),
        ({"scenes": ["cave"], "sensor": "vlp17"}, "no sensor 'vlp17'; choose from hdl32e, hdl64e"),
        ({"scenes": ["cave"], "rate": 5.0}, "a robot moves too fast for 5 scans a second"),
        ({"scenes": ["cave"], "stamp": "middle"}, "'start' or 'end'"),
        ({"scenes": ["cave"] * 3, "length": 9000.0}, "at most 20000 m"),
    ],
)
def test_bad_input_is_told(given, says):
    with pytest.raises(ValidationError, match=says):
        Course.model_validate(given)


@pytest.mark.parametrize(
    ("name", "rings", "first", "second", "last"),
    [
        ("vlp16", 16, -15.0, -13.0, 15.0),
        ("hdl32e", 32, -30.67, -29.33, 10.67),
        ("hdl64e", 64, -24.33, -23.83, 2.0),
        ("os0-64", 64, 45.0, 45.0 - 90.0 / 63.0, -45.0),
        ("os1-128", 128, 22.5, 22.5 - 45.0 / 127.0, -22.5),
    ],
)
def test_elevations_are_those_of_the_data_sheet(name, rings, first, second, last):
    sensor = SENSORS[name]
    looks = directions(name, sensor.columns)
    assert looks.shape == (sensor.columns, rings, 3)
    assert looks.dtype == np.float32
    elevations = np.degrees(np.arcsin(looks[7, :, 2].astype(float)))
    np.testing.assert_allclose(elevations[[0, 1, -1]], [first, second, last], atol=0.01)


def test_spinning_sensors_turn_once_clockwise_from_behind():
    looks = directions("vlp16", 360).astype(float)
    azimuth = np.unwrap(np.arctan2(looks[:, 0, 1], looks[:, 0, 0]))
    np.testing.assert_allclose(np.degrees(np.diff(azimuth)), -1.0, atol=1e-3)
    assert looks[0, 0, 0] < 0.0
    assert looks[90, 0, 1] > 0.0
