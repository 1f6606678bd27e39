import sys

import numpy as np
import pytest
import rec
from rooms import write_kitti
from scipy.spatial.transform import Rotation
from small_bag import texts

from adaptune import geometry
from adaptune._system import open3d
from adaptune.errors import import_extra
from adaptune.recording import SequenceConfig, SequenceError
from adaptune.recording.folder import read_scan, turn_up
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence


def poses(n):
    rng = np.random.default_rng(1)
    return geometry.from_quaternions(rng.normal(0, 3, (n, 3)), rng.normal(0, 1, (n, 4)))


S = 1_700_000_000 * 10**9


def kitti_odometry(folder, n=4):
    """Write a sequence, and tell where its LiDAR was as seen from its first camera's start."""
    (folder / "velodyne").mkdir(parents=True)
    for i, points in enumerate(rec.scans(n)):
        np.column_stack([points, np.ones(len(points), np.float32)]).astype("<f4").tofile(
            folder / "velodyne" / f"{i:06d}.bin"
        )
    (folder / "times.txt").write_text("".join(f"{i * 0.1:e}\n" for i in range(n)))
    T_camera_sensor, T_world_camera = poses(2)[1], poses(n)
    T_camera_sensor[:3, 3] *= 0.1
    T_world_camera[:, :3, 3] *= 0.1
    numbers = " ".join(map(repr, T_camera_sensor[:3].ravel().tolist()))
    (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {numbers}\n")
    (folder.parent.parent / "poses").mkdir()
    write_kitti(folder.parent.parent / "poses" / f"{folder.name}.txt", T_world_camera)
    return geometry.invert(T_camera_sensor) @ T_world_camera @ T_camera_sensor


def test_a_kitti_sequence_is_what_the_bags_are(tmp_path):
    expected = kitti_odometry(tmp_path / "sequences" / "00")
    sequence = open_sequence(SequenceConfig(kitti=str(tmp_path / "sequences" / "00"), elevation=0))
    bags = [
        list(open_sequence(SequenceConfig(bag=str(rec.drive(tmp_path / f"a{suffix}", n=4)))))
        for suffix in (".bag", ".sqlite3", ".mcap")
    ]
    scans = list(sequence)
    assert len(scans) == sequence.n_messages == 4
    for bag in bags:
        for a, b in zip(scans, bag, strict=True):
            assert np.array_equal(a.points, b.points)
            assert a.stamp == b.stamp - rec.START
    reference = sequence.reference()
    np.testing.assert_allclose(reference.T_world_sensor, expected, atol=1e-6)
    assert reference.stamps.tolist() == [scan.stamp for scan in scans]


def test_rays_are_turned_up_in_their_own_planes():
    rng = np.random.default_rng(0)
    points = rng.normal(0, 10, (200, 3)).astype(np.float32)
    axes = np.cross(points, [0, 0, 1])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    expected = Rotation.from_rotvec(axes * np.deg2rad(2.0)).apply(points)
    np.testing.assert_allclose(turn_up(points, 2.0), expected, atol=1e-5)
    up = np.array([[0, 0, 1], [0, 0, -1], [0, 0, 0]], np.float32)
    assert np.array_equal(turn_up(up, 2.0), up)


@pytest.mark.parametrize(("elevation", "degrees"), [(None, 0.205), (0.5, 0.5), (0, 0.0)])
def test_kittis_rays_are_corrected_unless_told_otherwise(tmp_path, elevation, degrees):
    folder = tmp_path / "sequences" / "00"
    kitti_odometry(folder)
    sequence = open_sequence(SequenceConfig(kitti=str(folder), elevation=elevation))
    expected = turn_up(rec.scans(1)[0], degrees)
    np.testing.assert_allclose(next(iter(sequence)).points, expected, atol=1e-6)


def test_clouds_that_only_open3d_reads_say_how_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "libusb_package", None)
    for cached in (import_extra, open3d.load):
        cached.cache_clear()
    (tmp_path / "1.ply").write_text("ply\n")
    what = r"1\.ply: open3d cannot be imported .*pip install 'adaptune\[open3d\]'"
    with pytest.raises(SequenceError, match=what):
        read_scan(tmp_path / "1.ply", 0)


@pytest.mark.parametrize("suffix", [".npy", ".pcd", ".ply", ".bin", "structured"])
def test_folders_of_files(tmp_path, suffix):
    for i, points in enumerate(rec.scans(11)):
        path = tmp_path / f"scan_{i}{suffix}"
        if suffix == ".npy":
            np.save(path, points)
        elif suffix == ".bin":
            np.column_stack([points, points[:, 0]]).tofile(path)
        elif suffix == "structured":
            np.save(tmp_path / f"scan_{i}.npy", rec.velodyne(points))
        else:
            o3d = open3d.load()
            cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
            cloud.point["time"] = o3d.core.Tensor(rec.velodyne(points)["time"][:, None].copy())
            o3d.t.io.write_point_cloud(str(path), cloud)
    scans = list(open_sequence(SequenceConfig(folder=str(tmp_path), period=0.5)))
    for i, (scan, points) in enumerate(zip(scans, rec.scans(11), strict=True)):
        assert np.array_equal(scan.points, points)
        assert scan.stamp == i * 500_000_000
        if suffix in (".pcd", ".ply", "structured"):
            assert np.array_equal(scan.times, rec.velodyne(points)["time"])


PCD = (
    "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\n"
    "VIEWPOINT {}\nPOINTS 1\nDATA ascii\n1 2 3\n"
)


@pytest.mark.parametrize(
    ("viewpoint", "fits"),
    [
        ("0 0 0 1 0 0 0", True),
        ("0 0 0 -1 0 0 0", True),
        ("0 0 1.5 1 0 0 0", False),
        ("0 0 0 0.7071 0 0 0.7071", False),
    ],
)
def test_points_that_may_be_in_another_frame_are_refused(tmp_path, viewpoint, fits):
    (tmp_path / "1.pcd").write_text(PCD.format(viewpoint))
    scans = open_sequence(SequenceConfig(folder=str(tmp_path)))
    if fits:
        assert next(iter(scans)).points.tolist() == [[1, 2, 3]]
    else:
        with pytest.raises(SequenceError, match=r"1\.pcd: .*VIEWPOINT is a pose.* 0 0 0 1 0 0 0"):
            list(scans)


def test_cloudcompares_intensities_are_read(tmp_path):
    columns = "".join(f"property float {name}\n" for name in ("x", "y", "z", "scalar_intensity"))
    header = f"ply\nformat ascii 1.0\nelement vertex 1\n{columns}end_header\n"
    (tmp_path / "1.ply").write_text(header + "1 2 3 7\n")
    (scan,) = open_sequence(SequenceConfig(folder=str(tmp_path)))
    assert scan.intensities.tolist() == [7]


@pytest.mark.parametrize(
    ("names", "times", "stamps"),
    [
        (["1", "2"], None, [0, 10**8]),
        (["1700000000.1", "1700000000.25"], None, [1700000000_1 * 10**8, 170000000025 * 10**7]),
        (["1700000000100000000", "1700000000250000000"], None, [17000000001 * 10**8] * 1),
        (["a1_1700000000100000", "a1_1700000000250000"], None, [S + 10**8, S + 25 * 10**7]),
        (["1700000000100", "1700000000250"], None, [S + 10**8, S + 25 * 10**7]),
        (["1700000000", "1700000003"], None, [S, S + 3 * 10**9]),
        (["1700000000_000000005", "1700000001_250000000"], None, [S + 5, S + 125 * 10**7]),
        (["c-1700000000-000005", "c-1700000001-250000"], None, [S + 5000, S + 125 * 10**7]),
        (["1700000000_5", "1700000000_250000000"], None, [S + 5, S + 25 * 10**7]),
        (["1700000000.9.pcd", "1700000000.10.pcd"], None, [S + 10**8, S + 9 * 10**8]),
        (["0000000000", "0000000001"], None, [0, 10**8]),
        # Nanoseconds and microseconds without leading zeros, and halves and quarters.
        ([f"1700000000.{n}" for n in (5, 200000005, 400000005, 600000005)], None, [S + 5]),
        ([f"170000000{n}" for n in ("0_5", "0_400005", "0_800005", "1_200005")], None, [S + 5000]),
        ([f"1700000000.{n}" for n in ("25", "5", "75")], None, [S + 25 * 10**7, S + 5 * 10**8]),
        ([f"1700000000_{n}" for n in ("05", "1", "15")], None, [S + 5 * 10**7, S + 10**8]),
        (["a20231114221320000", "a20231114221321250"], None, [S, S + 125 * 10**7]),
        (["2023-11-14-22-13-20.5", "2023-11-14-22-13-21.25"], None, [S + 5 * 10**8]),
        (["20231114.221320", "20231114.221323"], None, [S, S + 3 * 10**9]),
        (["1", "2"], "5.000000001\n6\n", [5_000_000_001, 6 * 10**9]),
        (["1", "2"], "1700000000100\n1700000000250\n", [S + 10**8, S + 25 * 10**7]),
        (["1", "2"], "1700000000000000005\n1700000001000000000\n", [S + 5, S + 10**9]),
        (["1", "2"], "2023-11-14 22:13:20.000000005\n2023-11-14 22:13:21\n", [S + 5, S + 10**9]),
    ],
)
def test_stamps_of_files(tmp_path, names, times, stamps):
    for name, points in zip(names, rec.scans(len(names)), strict=True):
        np.save(tmp_path / f"{name}.npy", points)
    if times:
        (tmp_path / "times.txt").write_text(times)
    found = [scan.stamp for scan in open_sequence(SequenceConfig(folder=str(tmp_path)))]
    assert found[: len(stamps)] == stamps


def test_hidden_files_are_no_scans(tmp_path):
    for name in ("1", "2"):
        np.save(tmp_path / f"{name}.npy", rec.scans(1)[0])
        (tmp_path / f"._{name}.npy").write_bytes(b"\0\5\x16\7")
    assert inspect(tmp_path).n_messages == 2


def test_names_that_look_like_times_and_are_not_read_are_told(tmp_path):
    for i, number in enumerate(("14_11_2023_221320_1", "14_11_2023_221320_6")):
        np.save(tmp_path / f"{number}.npy", rec.scans(2)[i])
    told = inspect(tmp_path)
    assert texts(told) == [
        "the names of the files look like times and are not read (14_11_2023_221320_1.npy); one "
        "every 0.1 s, as nothing gives their times; write a times.txt with the seconds of each "
        "scan, or set `period`"
    ]
    assert "points" in told.findings[0].of


@pytest.mark.parametrize("named", [".", "velodyne_points", "velodyne_points/data"])
def test_a_raw_recording_of_kittis_has_its_stamps_above_its_data(tmp_path, named):
    data = tmp_path / "velodyne_points" / "data"
    data.mkdir(parents=True)
    for i in (0, 2, 3):  # one is missing
        np.save(data / f"{i:010d}.npy", rec.scans(1)[0] + i)
    lines = "".join(f"2011-09-26 13:02:2{i}.951199337\n" for i in range(4))
    (data.parent / "timestamps.txt").write_text(lines)
    found = inspect(tmp_path / named)
    assert found.stamped_by == "timestamps.txt"
    assert not found.findings[1:]
    stamps = [scan.stamp for scan in open_sequence(found.config())]
    assert np.diff(stamps).tolist() == [2 * 10**9, 10**9]
    assert stamps[0] == 1317042140951199337


def columns_of(kind, points):
    n = len(points)
    made = {"i": np.full(n, 7.0), "r": np.arange(n) % 16, "t": np.linspace(0, 0.1, n)}
    made |= {"n": np.linspace(-9.0, 90.0, n), "x": points[:, 0]}
    return np.column_stack([points, *(made[one] for one in kind)]).astype("<f4")


@pytest.mark.parametrize(
    ("kind", "read"),
    [
        ("i", None),
        ("ir", "x y z intensity ring"),
        ("it", "x y z intensity time"),
        ("irt", "x y z intensity ring time"),
        ("itr", "x y z intensity time ring"),
        ("irnr", "x y z intensity ring unknown5 unknown6"),
        ("x", "below zero"),
    ],
)
def test_bin_files_hold_what_their_numbers_can_be(tmp_path, caplog, kind, read):
    for i, points in enumerate(rec.scans(3, points=240)):
        columns_of(kind, points).tofile(tmp_path / f"{i}.bin")
    found = inspect(tmp_path)
    scans = list(open_sequence(found.config()))
    for scan, points in zip(scans, rec.scans(3, points=240), strict=True):
        np.testing.assert_array_equal(scan.points, points)
        assert (scan.rings is not None) == ("r" in kind)
        assert (scan.times is not None) == ("t" in kind)
    said = [text for text in texts(found) if ".bin" in text]
    assert len(said) == (read is not None)
    if read is not None:
        assert read in said[0]
        assert said[0] in caplog.text


def test_a_kitti_pose_file_goes_with_any_recording(tmp_path):
    expected = poses(6)
    write_kitti(tmp_path / "gt.txt", expected)
    bag = str(rec.drive(tmp_path / "a.bag", n=6))
    reference = open_sequence(
        SequenceConfig(bag=bag, reference=str(tmp_path / "gt.txt"))
    ).reference()
    np.testing.assert_allclose(reference.T_world_sensor, expected, atol=1e-8)
    write_kitti(tmp_path / "gt.txt", expected[:5])
    with pytest.raises(SequenceError, match="5 poses without stamps do not go with 6 scans"):
        open_sequence(SequenceConfig(bag=bag, reference=str(tmp_path / "gt.txt"))).reference()


def headed(header):
    """A file of numpy's with this header."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


def broken(path, name, content):
    (path / name).write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("key", "make", "message"),
    [
        ("folder", lambda p: p / "none", "there is no such folder"),
        ("folder", lambda p: p, "holds no scan"),
        ("folder", lambda p: broken(p, "1.bin", bytes(17)), "17 bytes are not a whole number"),
        ("folder", lambda p: broken(p, "1.npy", b"\x93NUMPY\x01\x00"), "cannot be read as a scan"),
        ("folder", lambda p: broken(p, "1.npy", headed(b"{'descr': (")), "cannot be read as a"),
        ("folder", lambda p: broken(p, "1.pcd", b"VERSION .7\nFIELDS x y\n"), "damaged or holds"),
        ("kitti", lambda p: p / "none", "there is no such folder"),
        ("kitti", lambda p: p, "not a KITTI sequence"),
    ],
)
def test_broken_folders_are_clear_errors(tmp_path, key, make, message):
    with pytest.raises(SequenceError, match=message):
        list(open_sequence(SequenceConfig(**{key: str(make(tmp_path))})))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("times.txt", "0\n", "1 lines in times.txt for 4 scans"),
        ("times.txt", "0\na\n2\n3\n", "a line is not a time"),
        ("times.txt", None, "there is no such file"),
        ("velodyne/x.bin", "", "numbers do not go with"),
    ],
)
def test_broken_kitti_sequences_are_clear_errors(tmp_path, file, content, message):
    folder = tmp_path / "sequences" / "00"
    kitti_odometry(folder)
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(content)
    if file == "velodyne/x.bin":
        (folder / "velodyne" / "000000.bin").unlink()
    with pytest.raises(SequenceError, match=message):
        open_sequence(SequenceConfig(kitti=str(folder)))
