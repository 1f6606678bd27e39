import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from adaptune import geometry
from adaptune.trajectory import (
    Trajectory,
    TrajectoryError,
    is_kitti,
    read_kitti,
    read_oxts,
    read_trajectory,
    read_tum,
    write_kitti,
    write_tum,
)

STAMPS = st.lists(st.integers(-(10**18), 2 * 10**18), min_size=1, max_size=8, unique=True).map(
    sorted
)
NUMBERS = st.floats(-1e4, 1e4, allow_subnormal=False)


def some_poses(n):
    rng = np.random.default_rng(n)
    return geometry.from_quaternions(rng.normal(0, 10, (n, 3)), rng.normal(0, 1, (n, 4)))


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


def test_euroc_files_begin_their_quaternions_with_w(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "#timestamp [ns], p_RS_R_x [m], y, z, q_RS_w [], x, y, z, v_x\n"
        "1403636580838555648,1,2,3,0.7071067811865476,0,0,0.7071067811865476,9,9,9\n"
        "1403636580843555648,4,5,6,1,0,0,0,9,9,9\n"
    )
    trajectory = read_trajectory(path)
    assert trajectory.stamps.tolist() == [1403636580838555648, 1403636580843555648]
    np.testing.assert_allclose(trajectory.T_world_sensor[0][:3, 3], [1, 2, 3])
    np.testing.assert_allclose(
        trajectory.T_world_sensor[0][:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-12
    )
    np.testing.assert_allclose(trajectory.T_world_sensor[1][:3, :3], np.eye(3))


def test_oxts_files_are_metres_east_and_north(tmp_path):
    files = []
    for i, (latitude, longitude) in enumerate([(49.0, 8.4), (49.0, 8.401), (49.001, 8.4)]):
        files.append(tmp_path / f"{i}.txt")
        files[-1].write_text(f"{latitude} {longitude} {100 + i} 0.1 0.2 0.3 1 2 3\n")
    T = read_oxts(files)
    circle = 2 * np.pi * 6378137.0
    np.testing.assert_allclose(T[0][:3, 3], 0, atol=1e-9)
    np.testing.assert_allclose(
        T[1][:3, 3], [circle * 0.001 / 360 * np.cos(np.deg2rad(49)), 0, 1], atol=1e-3
    )
    np.testing.assert_allclose(T[2][:3, 3], [0, circle * 0.001 / 360, 2], atol=1e-2)
    # Roll about x first, then pitch, then yaw.
    cr, sr, cp, sp, cy, sy = (f(a) for a in (0.1, 0.2, 0.3) for f in (np.cos, np.sin))
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    np.testing.assert_allclose(T[0][:3, :3], Rz @ Ry @ Rx, atol=1e-12)


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
        ("a.csv", "1.5,0,0,0,1,0,0,0\n", "'1.5' is not a time in nanoseconds"),
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
