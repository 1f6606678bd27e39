import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rooms import write_kitti

from adaptune import geometry
from adaptune.trajectory import (
    Trajectory,
    TrajectoryError,
    is_kitti,
    read_kitti,
    read_trajectory,
    read_tum,
    write_tum,
)

STAMPS = st.lists(st.integers(-(10**18), 2 * 10**18), min_size=1, max_size=8, unique=True).map(
    sorted
)
NUMBERS = st.floats(-1e4, 1e4, allow_subnormal=False)


def some_poses(n):
    rng = np.random.default_rng(n)
    return geometry.from_quaternions(rng.normal(0, 10, (n, 3)), rng.normal(0, 1, (n, 4)))


@settings(deadline=None)  # the first example imports scipy
@given(STAMPS)
def test_tum_files_keep_every_nanosecond(tmp_path_factory, stamps):
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    trajectory = Trajectory(np.array(stamps), some_poses(len(stamps)))
    write_tum(path, trajectory)
    again = read_trajectory(path)
    assert again.stamps.tolist() == stamps
    np.testing.assert_allclose(again.T_world_sensor, trajectory.T_world_sensor, atol=1e-7)


@given(hnp.arrays(np.float64, st.tuples(st.integers(1, 5), st.just(3)), elements=NUMBERS))
def test_kitti_files_are_read_back(tmp_path_factory, translations):
    path = tmp_path_factory.mktemp("kitti") / "a.txt"
    T = some_poses(len(translations))
    T[:, :3, 3] = translations
    write_kitti(path, T)
    assert is_kitti(path)
    np.testing.assert_allclose(read_kitti(path), T, rtol=1e-9, atol=1e-9)


AT, TURN = "1,2,3", "0,0,0.70710678,0.70710678"
EUROC = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], "
ROS = "%time,field.header.frame_id,field.pose.pose.position.x,field.pose.pose.position.y," + (
    "field.pose.pose.position.z,field.pose.pose.orientation.x,field.pose.pose.orientation.y,"
    "field.pose.pose.orientation.z,field.pose.pose.orientation.w,field.pose.covariance0\n"
)
RECORDED = (
    "%time,field.header.seq,field.header.stamp,field.header.frame_id," + ROS.partition("id,")[2]
)
BAGPY = "Time,header.seq,header.stamp.secs,header.stamp.nsecs,header.frame_id," + (
    "pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,"
    "pose.orientation.z,pose.orientation.w\n"
)
JUGGLER = "__time,/o/header/stamp/nanosec,/o/header/stamp/sec," + ",".join(
    f"/o/pose/pose/{of}/{axis}" for of in ("position", "orientation") for axis in "xyzw"
).replace("/o/pose/pose/position/w,", "")


def axes(stem):
    return ",".join(stem + axis for axis in "xyz")


TURNED = "0,-1,0,1,1,0,0,2,0,0,1,3"
S, MS, NS = (("1700000000" + zeros, "1700000001" + zeros) for zeros in ("", "000", "0" * 9))


@pytest.mark.parametrize(
    ("header", "row", "stamps"),
    [
        ("", f"{{}},{AT},{TURN}\n", S),
        ("", f"{{}},{AT},{TURN}\n".replace(",", " "), S),
        ("", f"{{}}; {AT}; {TURN};\r\n", MS),
        ("\ufefftimestamp,x,y,z,qx,qy,qz,qw\n", f"{{}},{AT},{TURN}\n", NS),
        ("timestamp;x;y;z;qx;qy;qz;qw\n", f"{{}};{AT};{TURN}\n".replace(",", ";"), S),
        ("qw qx qy qz t tx ty tz\n", "0.70710678 0 0 0.70710678 {} 1 2 3\n", S),
        ("# Poses\n#sec,nsec,x,y,z,qx,qy,qz,qw\n", f"{{}},{AT},{TURN}\n", [f"{s},0" for s in S]),
        (ROS, f"{{}},lidar,{AT},{TURN},9\n", NS),
        (f"{EUROC}v_x\n", f"{{}},{AT},.70710678,0,0,.70710678,9,9,9\n", NS),
        (f"{EUROC}q_RS_y [], q_RS_z [], v_x\n", f"{{}},{AT},.70710678,0,0,.70710678,5\n", NS),
        # Decimal commas.
        (
            "t;x;y;z;qx;qy;qz;qw\n",
            "{};1,0;2;3,0;0;0;0,70710678;0,70710678\n",
            [f"{s},0" for s in S],
        ),
        ("", "{}\t1,0\t2,0\t3,0e0\t0\t0\t0,70710678\t0,70710678\n", [f"{s},0" for s in S]),
        ("", "{} ;1,0; 2,0;3,0;0;0;0,70710678;0,70710678;\n", S),
        # Matrices.
        ("", f"{{}},{TURNED}\n", NS),
        ("# stamp, r11, r12, ...\n", f"{{}},{TURNED},0,0,0,1\n".replace(",", " "), S),
        ("", f"{{}};{TURNED.replace(',', ',0;')},0\n", S),
        # The stamp of a message, not when it was recorded.
        (RECORDED, f"1{{}},5,{{}},lidar,{AT},{TURN},9\n", NS),
        (BAGPY, f"1.5,5,{{}},0,lidar,{AT},{TURN}\n", S),
        (f"{JUGGLER}\n", f"1.5,0,{{}},{AT},{TURN}\n", S),
        # Or that one, if the message has none.
        (RECORDED, f"{{}},5,0,lidar,{AT},{TURN},9\n", NS),
        # Rates and deviations beside, parts of another body, and two bodies.
        (f"t,{axes('rot_vel.')},{axes('p.')},{axes('q.')},q.w\n", f"{{}},9,9,9,{AT},{TURN}\n", S),
        (
            f"t,{axes('pos_std_')},{axes('q_std_')},q_std_w,{axes('pos_')},{axes('q_')},q_w\n",
            f"{{}},9,9,9,0,0,0,1,{AT},{TURN}\n",
            S,
        ),
        (
            f"t,{axes('aim.p.')},{axes('o.p.')},{axes('o.q.')},o.q.w\n",
            f"{{}},9,9,9,{AT},{TURN}\n",
            S,
        ),
        (
            f"t_used,t,{axes('a.p.')},{axes('a.q.')},a.q.w,{axes('far.p.')},{axes('far.q.')},far.q.w\n",
            f"9,{{}},{AT},{TURN},9,9,9,0,0,0,1\n",
            S,
        ),
        # ROS 2, without and with a second frame.
        ("", f"{{}},0,odom,{AT},{TURN}\n", S),
        ("", f"{{}},0,odom,,{AT},{TURN},0.1,0.1\n", S),
    ],
)
def test_poses_are_found_in_columns_of_any_order(tmp_path, header, row, stamps):
    text = header + "".join(row.replace("{}", stamp) for stamp in stamps)
    (tmp_path / "a.csv").write_text(text)
    assert not is_kitti(tmp_path / "a.csv")
    trajectory = read_trajectory(tmp_path / "a.csv")
    assert trajectory.stamps.tolist() == [17 * 10**17, 1700000001 * 10**9]
    want = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(trajectory.T_world_sensor, [want, want], atol=1e-7)


@pytest.mark.parametrize("row", [TURNED, f"{TURNED},0,0,0,1"])
def test_matrices_without_stamps_are_kittis(tmp_path, row):
    for name, text in (("a.txt", row.replace(",", " ")), ("a.csv", row)):
        (tmp_path / name).write_text(f"{text}\n" * 2)
        assert is_kitti(tmp_path / name)
        assert read_kitti(tmp_path / name)[1, :3, 3].tolist() == [1, 2, 3]


@pytest.mark.parametrize("row", ["0 1 0 -1 0 0 0 0 1 1 2 3", "2 0 0 0 0 2 0 0 0 0 2 0"])
def test_matrices_that_are_no_poses_are_refused(tmp_path, row):
    (tmp_path / "a.txt").write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{row}\n")
    with pytest.raises(TrajectoryError, match="line 2: its numbers are no rigid pose"):
        read_kitti(tmp_path / "a.txt")


def test_what_is_assumed_is_said_once(tmp_path, caplog):
    caplog.set_level("INFO")
    rows = {
        "comma": f"1,5;{AT};{TURN}".replace(",", ";").replace("1;5", "1,5"),
        "matrix": f"1.5,{TURNED}",
        "times": f"{RECORDED}1,5,2,a,{AT},{TURN},9",
        "ros2": f"1,0,odom,{AT},{TURN}",
    }
    for name, text in rows.items():
        (tmp_path / f"{name}.csv").write_text(text)
        for _ in range(2):
            read_trajectory(tmp_path / f"{name}.csv")
    said = [message.partition(".csv: ")[2] for message in caplog.messages]
    assert said == [
        "its numbers have decimal commas",
        "its lines are a stamp and the rows of a matrix",
        "of its columns of times, the stamps are those of column 3",
        "its columns are those of `ros2 topic echo --csv`",
    ]


def test_a_clock_of_nanoseconds_may_begin_with_zero(tmp_path):
    (tmp_path / "a.csv").write_text("".join(f"{i}00000000,{i},0,0,1,0,0,0\n" for i in range(4)))
    trajectory = read_trajectory(tmp_path / "a.csv")
    assert trajectory.stamps.tolist() == [0, 10**8, 2 * 10**8, 3 * 10**8]
    np.testing.assert_allclose(trajectory.T_world_sensor[:, :3, :3], np.tile(np.eye(3), (4, 1, 1)))


def test_of_poses_with_one_stamp_the_first_counts(tmp_path, caplog):
    lines = [f"{i} {i} 0 0 0 0 0 1\n" for i in range(12)]
    (tmp_path / "a.tum").write_text("".join([*lines[:6], "5 9 0 0 0 0 0 1\n", *lines[6:]]))
    trajectory = read_trajectory(tmp_path / "a.tum")
    assert trajectory.T_world_sensor[:, 0, 3].tolist() == list(range(12))
    assert "1 of 13 poses repeat the stamp before, first on line 7" in caplog.text


TUM_LINE = "1.5 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.tum", "", "holds no pose; give a file of"),
        ("a.tum", "1.5 0 0\n", "line 1: a TUM line has 8 numbers, this has 3"),
        ("a.tum", TUM_LINE + "2 0 0 0 0 0 0 x\n", "line 2: could not convert"),
        ("a.tum", "now 0 0 0 0 0 0 1\n", "line 1: 'now' is not a time"),
        ("a.tum", "2 0 0 0 0 0 0 1\n" + TUM_LINE, "line 2: its stamp does not come after"),
        ("a.tum", TUM_LINE + "# c\n2 0 0 0 0 0 0 0\n", "line 3: its quaternion has length 0"),
        ("a.tum", TUM_LINE + "2 0 0 0 0 0 0 2\n", r"line 2: .* length 2, .*columns 5, 6, 7, 8"),
        ("a.tum", TUM_LINE * 3, "2 of 3 poses repeat .* first on line 2; write .* digits"),
        ("a.csv", "1.5,0,0,0,1,0,0\n", "line 1: a CSV line has 8 numbers, this has 7; name other"),
        (
            "a.csv",
            f"1.5,{TURNED}\n2,0\n",
            "line 2: a line of matrices has 13 numbers here, this has 2",
        ),
        ("a.g2o", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n", "holds a pose graph .*; write a line"),
        (
            "a.txt",
            "header: \n  seq: 1\n",
            "holds messages as YAML; print them by `rostopic echo -p",
        ),
        ("a.txt", "---\npose:\n  x: 1\n", "holds messages as YAML"),
        ("a.txt", '<?xml version="1.0"?>\n<gpx>\n', "holds XML, JSON or NMEA; write a line"),
        ("a.json", '[{"x": 1}]\n', "holds XML, JSON"),
        ("a.txt", "$GPGGA,1,2\n", "holds XML, JSON"),
        ("a.csv", "1e19,0,0,0,1,0,0,0\n", "line 1: '1e19' is not a time"),
        ("a.csv", "t,x,y,z,yaw\n1.5,0,0,0,1\n", "line 1: names no column qx, qy, qz, qw; name"),
        ("a.csv", "w,t,x,y,z,qx,qy,qz,qw\n1,2,3,4,5,6,7,8\n", "line 2: a CSV line has 9 numbers"),
        # Columns of the matrix, one after the other.
        (
            "a.csv",
            "1.5,1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1\n2.5,0,1,0,0,-1,0,0,0,0,0,1,0,1,2,3,1\n",
            "line 2: its numbers are no rigid pose; write the rows",
        ),
    ],
)
def test_the_line_that_is_wrong_is_named(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(TrajectoryError, match=message) as caught:
        read_trajectory(tmp_path / name)
    assert name in str(caught.value)


@pytest.mark.parametrize("read", [read_tum, read_kitti, is_kitti, read_trajectory])
def test_files_that_are_no_text_are_refused(tmp_path, read):
    assert callable(read)
    with pytest.raises(TrajectoryError, match="there is no such file"):
        read(tmp_path / "none.tum")
    (tmp_path / "a.tum").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(TrajectoryError, match="cannot be read as text in UTF-8"):
        read(tmp_path / "a.tum")


@given(text=st.text(alphabet="0123456789.,-+eE naif#\n", max_size=300))
def test_any_text_gives_a_trajectory_or_an_error(tmp_path_factory, text):
    folder = tmp_path_factory.mktemp("any")
    for name in ("a.tum", "a.csv"):
        (folder / name).write_text(text)
        try:
            assert np.isfinite(read_trajectory(folder / name).T_world_sensor).all()
        except TrajectoryError:
            continue


@pytest.mark.parametrize(
    ("seconds", "help_"),
    [
        (1.4, "11 of 11 gaps of the reference are longer than max_gap = 1 s: .* `max_gap: 1.5` or"),
        (2.0, "`max_gap: 2` or more"),
        (1.0, "^$"),
    ],
)
def test_a_sparse_trajectory_says_what_to_set(seconds, help_):
    stamps = np.round(np.arange(12) * seconds * 1e9).astype(np.int64)
    assert re.search(help_, Trajectory(stamps, np.tile(np.eye(4), (12, 1, 1))).sparse)
