"""Parameter sets as the odometries' own tools read them."""

import re

import pytest
import yaml

from adaptune._system.files import write_text
from adaptune.errors import OdometryError
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.kiss_icp import Kiss
from adaptune.odometry.registry import declare, is_user_class, odometry_class
from adaptune.odometry.remote import Limits, Process
from adaptune.odometry.template import Template
from adaptune.space import ParameterSpace


def own_file(name, settings=None, space=None, **parameters):
    """What the factory of an odometry gives."""
    space = odometry_class(name).space if space is None else space
    factory, whole = OdometryFactory(name, settings or {}, space, Limits()).alone(parameters)
    return factory.own_file(whole)


def least(name):
    """The smallest value of every parameter, which is not the baseline."""
    parameters = odometry_class(name).space.parameters
    return {key: parameter.low for key, parameter in parameters.items()}


@pytest.mark.parametrize(
    "settings", [{}, {"deskew": False, "min_range": 2, "max_range": 60}], ids=["own", "given"]
)
def test_kiss_icp_loads_it(tmp_path, monkeypatch, settings):
    from kiss_icp.config import load_config

    tuned = least("kiss_icp") | {"min_motion_th": 1e-5}
    own = own_file("kiss_icp", settings, **tuned)
    path = tmp_path / f"fixed{own.suffix}"
    path.write_text(own.text)
    used = Kiss(tuned, Kiss.settings_type(**settings))._kiss.config
    assert load_config(path) == used
    assert used.adaptive_threshold.min_motion_th == 1e-5
    assert used.registration.max_num_threads == 1
    # It does not say where results go.
    monkeypatch.setenv("kiss_icp_out_dir", "elsewhere")
    assert load_config(path).out_dir == "elsewhere"


FLOAT = {"type": "float", "low": 0.0, "high": 1.0, "baseline": 0.5}
TEMPLATE = "# of the robot\nmap: {voxel: 1.0, size: 1e3}\nuse_sim_time: on\n"


@pytest.mark.parametrize(
    ("name", "settings", "use"),
    [
        ("command", {"command": ["slam", "{input}", "{parameters}", "-d={d}"]}, "-d=0.25"),
        ("docker_command", {"image": "slam"}, "in the place of slam.yaml"),
        ("rustle", {"image": "slam", "odometry": "/odom"}, "in the place of slam.yaml"),
    ],
)
def test_a_template_keeps_all_else(tmp_path, name, settings, use):
    space = ParameterSpace.load({"map.voxel": FLOAT} | ({"d": FLOAT} if name == "command" else {}))
    (tmp_path / "slam.yaml").write_text(TEMPLATE)
    given = settings | {"template": str(tmp_path / "slam.yaml")}
    own = own_file(name, given, space, **dict.fromkeys(space.names, 0.25))
    assert own.text == TEMPLATE.replace("1.0", "0.25")
    assert own.suffix == ".yaml"
    assert own.use == (f"slam {{input}} FILE {use}" if name == "command" else use)


def test_odometries_without_a_tool_of_their_own():
    for name in ("gicp", "ndt"):
        assert own_file(name) is None
    assert own_file("command", {"command": ["slam"]}, ParameterSpace({})) is None
    assert Process.own_file({}, None) is None
    # A class of the user is not imported, whatever it is derived from.
    factory = OdometryFactory("kiss_icp", {}, Kiss.space, Limits())
    object.__setattr__(factory, "name", "theirs.odometry:Mine")
    assert is_user_class(factory.name)
    assert factory.own_file({}) is None


PUBLISHED = b"""# Faster-LIO, Velodyne 32 \xc2\xb0\r
common:\r
    lid_topic:  "/points_raw"   # two spaces\r
    time_sync_en: off\r
preprocess: {lidar_type: 2, time_scale: 1e3, scan_rate: 010}\r
mapping:\r
    acc_cov: 0.1\r
    gyr_cov: 1e-2\r
    det_range:    100.0\r
    extrinsic_T: [ 0, 0, 0.28 ]\r
    filter_size_surf: 0.5\r
    stamp: 12:30\r
    empty:\r
    filter_size_surf: 0.4 # last\r
point_filter_num: 4\r
"""


def test_a_published_parameter_file_is_read_as_ros_reads_it(tmp_path):
    path = tmp_path / "params.yaml"
    path.write_bytes(PUBLISHED)
    template, held = Template(path), yaml.safe_load(PUBLISHED)
    for name in template.names:
        value = held
        for key in template.path_of(name):
            value = value[int(key) if isinstance(value, list) else key]
        assert template.value(name) == value
    text = template.fill({"filter_size_surf": 0.25, "gyr_cov": 1, "empty": 7.0, "extrinsic_T/2": 1})
    expected = PUBLISHED.replace(b"0.4 #", b"0.25 #").replace(b"1e-2", b"1.0")
    expected = expected.replace(b"0.28", b"1.0")
    assert text.encode() == expected.replace(b"empty:", b"empty: 7.0")
    assert template.fill({}).encode() == PUBLISHED


@pytest.mark.parametrize("text", ["c: 2\na: &x 1.0\nb: *x\n", "c: &x 2.0\na: *x\n"])
def test_a_value_that_others_share_is_not_replaced(tmp_path, text):
    path = tmp_path / "shared.yaml"
    path.write_text(text)
    with pytest.raises(OdometryError, match=r"shared.yaml: .* \(line 2\); write its value without"):
        Template(path).fill({"a": 3.0})


USERS = """# of the robot \u00b0
out_dir: "/data"   # a big disk
data: {deskew: on, max_range: 80.0, min_range: 3}
mapping:
  voxel_size:  0.8
adaptive_threshold: {initial_threshold: 2, min_motion_th: 1e-1}
"""
ROS2 = "kiss_icp_node:\n  ros__parameters:\n    base_frame: base\n    voxel_size: 5.0\n"
EVALIO = "pipelines:\n  - {pipeline: kiss, voxel_size: 0.7, max_num_threads: 0}\n  - loam\n"


@pytest.mark.parametrize(
    ("name", "text", "baseline"),
    [
        ("kiss_icp", USERS, {"voxel_size": 0.8, "initial_threshold": 2.0, "min_motion_th": 0.1}),
        ("kiss_icp", ROS2, {"voxel_size": 5.0}),
        ("evalio_kiss_icp", EVALIO, {"voxel_size": 0.7}),
        ("evalio_kiss_icp", ROS2, {"voxel_size": 5.0}),
    ],
)
def test_the_user_s_file_is_the_start_and_keeps_all_else(tmp_path, name, text, baseline):
    path = tmp_path / "users.yaml"
    path.write_text(text)
    settings, described = declare(name, {"config": str(path)}).sound(name)
    assert described.space.baseline == baseline
    factory = OdometryFactory(name, settings, described.space, Limits())
    assert factory.own_file(baseline).text == text
    changed = factory.own_file(baseline | {"voxel_size": 0.25}).text
    assert changed == text.replace(str(baseline["voxel_size"]), "0.25")
    # Results do not outlive a change of the file.
    before = factory.content
    path.write_text(text + "# changed\n")
    assert factory.content != before


def test_kiss_icp_drives_what_its_own_tool_would(tmp_path):
    from kiss_icp.config import load_config

    path = tmp_path / "users.yaml"
    path.write_text(USERS.replace("  voxel_size:  0.8\n", "  max_points_per_voxel: 9\n"))
    made = Kiss(None, Kiss.settings_type(config=str(path)))
    expected = load_config(path)
    used = made._kiss.config
    assert (used.data, used.mapping) == (expected.data, expected.mapping)
    assert used.mapping.voxel_size == 0.8  # a hundredth of the range, as there
    assert (made.settings.min_range, made.settings.max_range) == (3.0, 80.0)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("kiss_icp", "mapping:\n  voxel_size: big\n", "line 2: voxel_size: 'big' is no number"),
        ("kiss_icp", "a: 1\n", "holds none of voxel_size"),
        ("kiss_icp", "mapping: {voxel_size: 1.0}\ndata: {deskew: x}\n", "data.deskew"),
        (
            "kiss_icp",
            USERS.replace("voxel_size", "voxelsize"),
            "line 5: mapping.voxelsize: KISS-ICP has no such value; did you mean 'mapping.voxel_",
        ),
        ("kiss_icp", "data: {voxel_size: 1.0}\n", "did you mean 'mapping.voxel_size'?"),
        ("genz_icp", EVALIO, "is to hold one pipeline 'genz'; there is kiss"),
        ("kiss_icp", None, "there is no such file"),
    ],
)
def test_a_file_of_something_else_is_refused(tmp_path, name, text, words):
    path = tmp_path / "users.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(OdometryError, match=r"users\.yaml") as caught:
        declare(name, {"config": str(path)})
    assert words in str(caught.value)


def test_kiss_icp_s_file_may_hold_all_that_it_knows_and_unknown_sections_are_told(tmp_path, caplog):
    from kiss_icp.config import KISSConfig

    path = tmp_path / "users.yaml"
    path.write_text(yaml.dump(KISSConfig(mapping={"voxel_size": 0.8}).model_dump()))
    given = {"config": str(path)}
    assert declare("kiss_icp", given).mistakes == []
    assert not caplog.records
    path.write_text(path.read_text() + "robot:\n  voxelsize: 0.5\n  frame: base\n")
    assert declare("kiss_icp", given).mistakes == []
    (said,) = caplog.messages
    assert re.search(r"nothing reads robot.voxelsize \(line \d+\): KISS-ICP has no such", said)


@pytest.mark.parametrize(
    ("name", "text", "unread"),
    [
        ("kiss_icp", "voxel_size: 1.0\nvoxle: 2.0\nframe: base\n", "voxle (line 2)"),
        ("kiss_icp", ROS2 + "    reach: 3\n    visualize: true\n", "reach (line 5)"),
        ("genz_icp", ROS2 + "    max_range: 80.0\n", "max_range (line 5)"),
        ("evalio_kiss_icp", EVALIO.replace("max_num", "num"), "pipelines.0.num_threads (line 2)"),
        ("kiss_icp", ROS2 + "    covariance: {position_covariance: 0.1}\n", None),
    ],
)
def test_numbers_that_nothing_reads_are_told(tmp_path, caplog, name, text, unread):
    path = tmp_path / "users.yaml"
    path.write_text(text)
    declare(name, {"config": str(path)})
    said = [message for message in caplog.messages if "nothing reads" in message]
    assert len(said) == (unread is not None)
    assert unread is None or f"{path}: nothing reads {unread}: " in said[0].replace(
        "kiss_icp_node.", ""
    )


@pytest.mark.parametrize(
    ("name", "text", "whose"),
    [
        ("kiss_icp", ROS2 + "    planarity_threshold: 0.2\n", ("planarity_threshold", "genz_icp")),
        ("kiss_icp", "dlio: {vf_res: 0.3}\n", ("vf_res", "dlio")),
        ("genz_icp", "voxel_size: 1\nnum_iters_icp: 9\n", ("num_iters_icp", "ct_icp")),
    ],
)
def test_another_odometry_s_file_is_refused_with_its_name(tmp_path, name, text, whose):
    path = tmp_path / "users.yaml"
    path.write_text(text)
    with pytest.raises(OdometryError, match=rf"users.yaml: holds {whose[0]}, which {name}") as told:
        declare(name, {"config": str(path)})
    assert f"--odometry {whose[1]}" in str(told.value)
    # What is common to several is nobody's own.
    path.write_text("voxel_size: 1.0\nmax_num_iterations: 5\n")
    assert declare("kiss_icp", {"config": str(path)}).mistakes == []


def test_a_key_that_comes_twice_is_told_with_both_lines(tmp_path, caplog):
    path = tmp_path / "twice.yaml"
    path.write_text("map: &m\n  size: 0.5\nmap:\n  size: 1.5\nb: {<<: *m, size: 2}\n")
    template = Template(path)
    assert template.value("map.size") == 1.5
    places = [("map", 3, 1), ("map.size", 4, 2)]
    for said, (name, line, first) in zip(caplog.messages, places, strict=True):
        assert f"{path}, line {line}: {name} is given twice, first in line {first}" in said
    path.write_text("map.size: 1.0\nmap: {size: 0.5}\n")
    with pytest.raises(OdometryError, match=r"map.size \(line 1\), map.size \(line 2\)"):
        Template(path).value("size")


OPENCV = b"""%YAML:1.0
---
# \xcc\xe5\xcb\xd8 \x85
T: !!opencv-matrix
   rows: 1
   cols: 2
   dt: d
   data: [ 1., 0. ]
Map.size: 0.5 # \xc3\xd7
yaw: !degrees 90
"""


@pytest.mark.parametrize(
    "head", [b"%YAML:1.0\n---\n", b"%YAML:1.0\n", b"\xef\xbb\xbf%YAML:1.0\r\n", b""]
)
def test_files_of_opencv_and_other_encodings_keep_all_else(tmp_path, head):
    text = OPENCV.replace(b"%YAML:1.0\n---\n", head)
    (path := tmp_path / "orb.yaml").write_bytes(text)
    template = Template(path)
    assert template.value("T.data.0") == 1.0
    command = {"command": ["slam", "{parameters}"], "template": str(path)}
    own = own_file(
        "command", command, ParameterSpace.load({"Map.size": FLOAT}), **{"Map.size": 0.25}
    )
    write_text(path, own.text)
    assert path.read_bytes() == text.replace(b"0.5 #", b"0.25 #")
    with pytest.raises(OdometryError, match="without anchors, aliases and tags"):
        template.fill({"yaw": 80.0})
    path.write_bytes("size: 1.0".encode("utf-16"))
    with pytest.raises(OdometryError, match=r"orb.yaml: is not text in UTF-8"):
        Template(path)


def test_what_the_file_gives_is_not_given_twice(tmp_path):
    (tmp_path / "users.yaml").write_text(USERS)
    given = {"config": str(tmp_path / "users.yaml")}
    (mistake,) = declare("kiss_icp", given | {"min_range": 2.0}).mistakes
    assert "min_range is taken from" in str(mistake)
    whole = Kiss.settings_type(**given).model_dump()
    assert whole == given
    assert declare("kiss_icp", whole).mistakes == []
    # Folders of earlier studies name the defaults, too.
    assert declare("kiss_icp", given | {"min_range": 1.0, "deskew": True}).mistakes == []
