import pytest
from contained import template
from pydantic import ValidationError

from adaptune.odometry import OdometryError
from adaptune.odometry.docker.engine import EngineError
from adaptune.odometry.docker.rustle import Rustle, RustleSettings


def settings(**given):
    return RustleSettings(**({"image": "x", "template": "p.yaml", "odometry": "/o"} | given))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"odometry": "Odometry"}, "odometry"),
        ({"points": "points"}, "points"),
        ({"package": "a; rm"}, "package"),
        ({"arguments": ("a:=$(b)",)}, "arguments"),
        ({"play": "both"}, "play"),
        ({"rate": 0}, "rate: 0 is for play: lockstep"),
        ({"rate": -1}, "rate"),
        ({"image": ""}, "image"),
        ({"node": "/gicp"}, "node: parameters change only with play: lockstep"),
        (
            {"play": "lockstep", "set_parameter": ("x", "{name}={value}")},
            r"set_parameter: name the node, too \(node\)",
        ),
        (
            {"play": "lockstep", "node": "/n", "set_parameter": ("x", "{value}")},
            "names no {name} in its arguments",
        ),
    ],
)
def test_settings_that_are_refused(given, words):
    with pytest.raises(ValidationError, match=words):
        settings(**given)


def test_what_it_says_of_itself():
    for given, live, needs_imu, whole in (
        ({}, False, False, True),
        ({"imu": "/imu"}, False, False, True),
        ({"play": "lockstep"}, False, False, False),
        ({"play": "lockstep", "imu": "/imu"}, False, True, False),
        ({"play": "lockstep", "node": "/n"}, True, False, False),
    ):
        described = Rustle.describe(settings(**given))
        assert described.space is None
        assert (described.live, described.needs_imu, described.whole) == (live, needs_imu, whole)
    assert settings().packages == ("rustle-ros", "rustle")
    assert settings(package="own").packages == ("own",)


def test_what_is_checked_before_a_campaign(tmp_path, monkeypatch):
    file = template(tmp_path / "params.yaml")
    with pytest.raises(OdometryError, match=r"no-file\.yaml: there is no such file"):
        Rustle.check(settings(template=str(tmp_path / "no-file.yaml")), {})
    json = tmp_path / "params.json"
    json.write_text("{}")
    with pytest.raises(OdometryError, match=r"template: .*params\.json is not YAML, as ROS 1"):
        Rustle.check(settings(template=str(json)), {})
    given = settings(template=str(file))
    with pytest.raises(OdometryError, match=r"voxl: .*params\.yaml has no such value; .*voxel"):
        Rustle.check(given, {"voxl": 1.0})
    asked = []

    def image_digest(name):
        asked.append(name)
        raise EngineError("there is no image")

    monkeypatch.setattr("adaptune.odometry.docker.rustle.image_digest", image_digest)
    with pytest.raises(OdometryError, match="there is no image"):
        Rustle.check(given, {"other.voxel": 1.0, "keyframe_interval": 1.0})
    assert asked == ["x"]
