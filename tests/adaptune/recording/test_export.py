import numpy as np
import pytest
import turns

from adaptune.recording import Imu, Scan, SequenceConfig
from adaptune.recording.clouds import decode_livox
from adaptune.recording.export import Messages, export
from adaptune.recording.recording import open_sequence
from adaptune.ros.ros2 import message_types

FIRST = 1_700_000_000_123_456_000


def scans(n=3):
    return [
        Scan(FIRST + s.stamp, s.points, s.times, s.rings, intensities=s.points[:, 0] % 255.0)
        for s in (turns.turn(i) for i in range(n))
    ]


@pytest.mark.parametrize("layout", ["bag", "ros2"])
def test_bags_hold_all_that_scans_hold(tmp_path, layout):
    path = tmp_path / {"bag": "run.bag", "ros2": "run"}[layout]
    imu = Imu(
        FIRST + np.arange(0, 300, 10, dtype=np.int64) * 10**6,
        np.random.default_rng(0).normal(size=(30, 3)),
        np.random.default_rng(1).normal(size=(30, 3)),
    )
    export(scans(), imu, path, layout)
    config = {"bag": str(path), "imu": {}, "cache": False}
    sequence = open_sequence(SequenceConfig.model_validate(config))
    for found, scan in zip(sequence, scans(), strict=True):
        assert abs(found.stamp - scan.stamp) < 1000
        np.testing.assert_array_equal(found.points, scan.points)
        np.testing.assert_array_equal(found.rings, scan.rings)
        np.testing.assert_array_equal(found.intensities, scan.intensities)
        np.testing.assert_allclose(found.times, scan.times, atol=1e-6)
    found = sequence.imu()
    np.testing.assert_array_equal(found.stamps, imu.stamps)
    np.testing.assert_array_equal(found.angular_velocity, imu.angular_velocity)
    np.testing.assert_array_equal(found.acceleration, imu.acceleration)


def test_a_kitti_folder(tmp_path):
    export(scans(), None, tmp_path / "kitti", "kitti")
    folder = str(tmp_path / "kitti" / "sequences" / "00")
    found = list(open_sequence(SequenceConfig.model_validate({"kitti": folder, "elevation": 0})))
    for i, (there, scan) in enumerate(zip(found, scans(), strict=True)):
        assert there.stamp == pytest.approx(i * 10**8, abs=1000)
        np.testing.assert_array_equal(there.points, scan.points)
        np.testing.assert_array_equal(there.intensities, scan.intensities)


@pytest.mark.parametrize("n", [0, 1, 500])
@pytest.mark.parametrize("frame", ["", "lidar", "livox_frame"])
def test_a_scan_as_a_livox_message_is_that_scan(n, frame):
    rng = np.random.default_rng(n)
    points = rng.normal(size=(n, 3)).astype(np.float32)
    times = np.sort(rng.uniform(0, 0.1, n)).astype(np.float32)
    rings, light = (rng.integers(0, 200, n) for _ in range(2))
    scan = Scan(FIRST, points, times, rings.astype(np.uint16), intensities=light.astype("f4"))
    messages = Messages(2)
    data = messages.livox(messages.header("/livox", FIRST, frame), scan)
    store = message_types()
    read = store.deserialize_cdr(data, "livox_ros_driver2/msg/CustomMsg")
    assert (read.point_num, read.timebase, read.header.frame_id) == (n, FIRST, frame)
    assert len(read.points) == n
    found = decode_livox(data, cdr=True)
    np.testing.assert_array_equal(found.points, points)
    if n:
        assert [point.line for point in read.points] == rings.tolist()
        np.testing.assert_allclose(found.times, times, atol=1e-8)
        np.testing.assert_array_equal(found.intensities, light)
