import re
import socket

import local_link
import pytest
import yaml
from pydantic import ValidationError

from adaptune.odometry import OdometryError
from adaptune.odometry.systems import ros_system
from adaptune.odometry.systems.ros2_system import DIED, NOISE, Ros2Settings, Ros2System
from adaptune.odometry.systems.rustle import (
    Ros1System,
    RustleSettings,
    server_keys,
    warn_of_unread,
)
from adaptune.odometry.template import Template

HELD = {
    "gicp": {"keyframe_interval": 1.5, "iterations": 20, "robust": True, "name": "x"},
    "front": {"gicp": {"keyframe_interval": 1.5}},
    "other": {"voxel": 2, "gicp_keyframe_interval": 1.0},
    "gate": "",
}
FILE = """\
gicp: {keyframe_interval: 0.0, iterations: 1, robust: false, name: y}
other/voxel: 1.0
use_sim_time: true
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text(FILE)
    return Template(path)


def test_a_value_of_many_names(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_text("a: {b/c: {d: 1}, e: [1, 2], list: [{d: 2}, {d: 3}]}\nb: {d: 1}\nd: 4\n")
    held = Template(path)
    assert held.path_of("c.d") == ("a", "b", "c", "d")
    assert held.path_of("a.e.1") == ("a", "e", "1")
    assert held.path_of("list.1.d") == ("a", "list", "1", "d")
    assert held.path_of("d") == ("d",)
    assert held.path_of("b.d") == ("b", "d")
    path.write_text("a: {x: 1}\nb: {x: 1}\n")
    several = r"'x' may be any of a\.x \(line 1\), b\.x \(line 2\); name one of them"
    with pytest.raises(OdometryError, match=several):
        Template(path).path_of("x")


def test_where_the_parameter_server_holds_them(file):
    given = {"keyframe_interval": 1.5, "iterations": 20, "gicp.robust": True, "voxel": 2.0}
    assert server_keys(file, given, HELD) == {
        # A launch file may load the file into groups, and more than once.
        "gicp/keyframe_interval": ["/gicp/keyframe_interval", "/front/gicp/keyframe_interval"],
        "gicp/iterations": ["/gicp/iterations"],
        "gicp/robust": ["/gicp/robust"],
        "other/voxel": ["/other/voxel"],
    }
    assert server_keys(file, {}, None) == {}


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"use_sim_time": True},
            "the parameter server holds no use_sim_time: the launch file does",
        ),
        ({"iterations": 21}, r"/gicp/iterations is 20 on the parameter server, not 21: the launch"),
        ({"robust": 1}, "/gicp/robust is True on the parameter server, not 1"),
    ],
)
def test_values_that_do_not_arrive(file, given, words):
    with pytest.raises(OdometryError, match=words):
        server_keys(file, given, HELD)


class Asked:
    """Stands for a link: which node has asked for which parameters."""

    def __init__(self, **asked):
        self._asked = {f"/{name}": keys for name, keys in asked.items()}

    def ask(self, kind):
        assert kind == "asked"
        return self._asked


@pytest.mark.parametrize(
    ("asked", "warned"),
    [
        ({"gicp": ["/gicp/voxel"]}, False),
        ({"gicp": ["/gicp/"]}, False),
        ({"gicp": ["/gicp"]}, False),
        ({"gicp": ["/gicp/vox"]}, True),
        ({"gicp": ["/voxel", "/other"]}, True),
        ({"roslaunch_1": ["/gicp/voxel"], "adaptune_1": ["/gicp"], "rosparam-1": ["/gicp"]}, True),
        ({}, True),
    ],
)
def test_parameters_that_no_node_reads_are_named_once(asked, warned, caplog, request):
    # An image is warned of once.
    for _ in range(2):
        warn_of_unread(Asked(**asked), request.node.name, {"voxel": ["/gicp/voxel"]})
    assert len(caplog.messages) == warned
    assert all("no node has read the parameter voxel" in message for message in caplog.messages)


@pytest.mark.parametrize(
    ("text", "name", "known", "line"),
    [
        ("a: {b: 1.0}\n", "b", "a.b", "    a: {b: 2.0}"),
        ("%YAML 1.2\n---\na.b: 1.0\n", "a.b", "a.b", "    a.b: 2.0"),
        ("/**:\n  ros__parameters:\n    a: {b: 1.0}\n", "a.b", "a.b", "    a: {b: 2.0}"),
        ("icp:\n  ros__parameters:\n    a.b: 1.0\n", "icp.a.b", "a.b", "    a.b: 2.0"),
    ],
)
def test_a_file_is_laid_out_as_ros_2_reads_it(tmp_path, text, name, known, line):
    path = tmp_path / "params.yaml"
    path.write_text(text)
    held = Template(path)
    assert held.ros2_name(name) == known
    filled = Ros2System.laid_out(held, held.fill({name: 2}))
    assert line in filled.splitlines()
    data = yaml.safe_load(filled)
    (inside,) = data.values()
    assert set(data) <= {"/**", "icp"}
    assert inside["ros__parameters"] in ({"a": {"b": 2.0}}, {"a.b": 2.0})


def test_a_number_that_ros_1_takes_for_a_text_is_told(tmp_path, caplog):
    path = tmp_path / "params.yaml"
    path.write_text("a:\n  scale: 1e3\n  sound: 1.0e+3\n  word: '1e3'\n  small: -2e-4\n")
    Template(path).warn_of_texts()
    said = [record.getMessage() for record in caplog.records]
    assert [words.split(" for a text")[0] for words in said] == [
        f"{path}:2: ROS 1 takes a.scale: 1e3",
        f"{path}:5: ROS 1 takes a.small: -2e-4",
    ]
    assert "write 1000.0" in said[0]


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("ros2", "launch"), "no argument holds {parameters}"),
        (("ros2", "{parameter}"), "{parameter} is nothing; did you mean 'parameters'"),
    ],
)
def test_a_command_must_name_the_file(command, words):
    with pytest.raises(ValidationError, match=re.escape(words)):
        Ros2Settings(command=command, template="p.yaml", odometry="/odometry")


def test_a_node_that_dies_under_ros2_launch_is_known_by_what_that_writes():
    line = b"[ERROR] [kiss_icp_node-1]: process has died [pid 53, exit code -11, cmd '/opt/x --y']."
    found = DIED.search(b"[INFO] [launch]: All log files can be found below /x\n" + line)
    assert (found[1], found[2]) == (b"kiss_icp_node", b"-11")
    assert NOISE.fullmatch(b"[INFO] [kiss_icp_node-1]: process started with pid [53]")


class Elsewhere:
    """A system without a container, whose node subscribes to other clouds."""

    def _begin(self):
        self._connected = socket.socket(socket.AF_UNIX)
        self._connected.connect(str(self.folder / "link"))

    def _linked(self, connection):
        connection.close()
        return local_link.LocalLink()

    def state(self):
        return {"subscribed": {"/velodyne": ["a"], "/clock": ["b"]}, "sending": {}}

    def stop(self):
        self._connected.close()


@pytest.mark.parametrize("base", [Ros1System, Ros2System])
def test_what_is_waited_for_is_told_once(base, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(ros_system, "LONG", 0.1)
    caplog.set_level("INFO")
    common = {"template": "p.yaml", "odometry": "/o", "ready": 0.3, "image": "x"}
    one, two = RustleSettings(**common), Ros2Settings(**common, command=("x", "{parameters}"))
    given = one if base is Ros1System else two
    system = type("Elsewhere", (Elsewhere, base), {})(given, 1.0, "", tmp_path)
    system.cloud_type("/points")
    heard = r"\(topics with subscribers: /velodyne\)"
    words = f"no node subscribed to the clouds' topic /points in 0.3 s {heard}; name the topic"
    with pytest.raises(OdometryError, match=words):
        system.wait("/points")
    system.stop()
    (said,) = caplog.messages
    words = f"x: waits up to 0.3 s for a node to subscribe to the clouds' topic /points {heard}"
    assert re.fullmatch(words, said)
