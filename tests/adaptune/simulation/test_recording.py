import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.simulation import Course, SimulationError
from adaptune.simulation.record import SimulatedDrive, record, simulate
from adaptune.trajectory import read_tum

COURSE = Course(
    scenes=("corridor",), length=10.0, sensor="vlp16", columns=60, imu=200, motion="car"
)


@pytest.fixture(scope="module")
def scans():
    return list(simulate(COURSE))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "run.bag"
    record(COURSE, path)
    return path


def stamp_ns(header):
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def read(path, topic):
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [
            (t, reader.deserialize(raw, c.msgtype)) for c, t, raw in reader.messages(connections)
        ]


def test_clouds_are_as_velodyne_s_driver_writes_them(recording, scans):
    messages = read(recording, "/velodyne_points")
    assert len(messages) == len(scans)
    for (sent, message), scan in zip(messages, scans, strict=True):
        assert stamp_ns(message.header) == scan.stamp
        assert sent == scan.stamp + 10**8
        assert message.header.frame_id == "velodyne"
        assert [(f.name, f.offset, f.datatype) for f in message.fields] == [
            *(("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7)),
            *(("ring", 16, 4), ("time", 18, 7)),
        ]
        assert message.point_step == 22
        assert message.width == len(scan)


def test_truth_reads_back(recording, scans):
    truth = read_tum(recording.with_suffix(".tum"))
    assert len(truth) == len(scans) + 1
    messages = read(recording, "/gt_poses")
    assert [stamp_ns(m.header) for _, m in messages] == truth.stamps.tolist()
    for i, scan in enumerate(scans):
        assert truth.stamps[i] == scan.stamp
        np.testing.assert_allclose(truth.T_world_sensor[i], scan.T_world_sensor, atol=1e-8)
        p = messages[i][1].pose.position
        np.testing.assert_array_equal([p.x, p.y, p.z], scan.T_world_sensor[:3, 3])


def test_inertial_measurements_read_back(recording, scans):
    messages = [m for _, m in read(recording, "/imu/data")]
    stamps = np.array([stamp_ns(m.header) for m in messages])
    assert stamps[0] == scans[0].stamp
    assert np.all(np.diff(stamps) == 5_000_000)
    assert stamps[-1] == scans[-1].stamp + 10**8
    force = np.array([m.linear_acceleration.z for m in messages])
    np.testing.assert_allclose(force.mean(), 9.8, atol=0.1)
    assert messages[0].orientation_covariance[0] == -1.0


@pytest.mark.parametrize("stamp", ["start", "end"])
def test_the_reader_of_sequences_takes_it(tmp_path, scans, stamp):
    path = tmp_path / "run.bag"
    record(COURSE.model_copy(update={"stamp": stamp}), path)
    config = {"bag": str(path), "reference": "/gt_poses", "cache": False}
    sequence = open_sequence(SequenceConfig.model_validate(config))
    for found, scan in zip(sequence, scans, strict=True):
        assert abs(found.stamp - scan.stamp) < 1_000_000
        for name in ("points", "rings", "intensities"):
            np.testing.assert_array_equal(getattr(found, name), getattr(scan, name))
        drift = (found.stamp - scan.stamp) * 1e-9
        np.testing.assert_allclose(found.times + drift, scan.times, atol=1e-6)
    reference = sequence.reference().at(np.array([scan.stamp for scan in scans]))
    np.testing.assert_allclose(reference, [s.T_world_sensor for s in scans], atol=1e-9)


def test_what_is_there_is_not_touched_unasked(tmp_path):
    path = tmp_path / "run.bag"
    for name in ("run.bag", "run.tum", "run.json"):
        (tmp_path / name).write_text("mine")
        with pytest.raises(SimulationError, match=f"{name} exists already; give --overwrite"):
            record(COURSE, path)
        assert (tmp_path / name).read_text() == "mine"
        (tmp_path / name).rename(tmp_path / "kept")
    (tmp_path / "run.bag").write_text("old")
    record(COURSE, path, overwrite=True)
    assert path.stat().st_size > 1000


def test_nothing_is_left_of_an_interrupted_recording(tmp_path):
    def interrupt(name, done, total):
        assert (name, total) == ("run", len(SimulatedDrive(COURSE)))
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(COURSE, tmp_path / "run.bag", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_of_a_stride_every_so_many_th_scan_is_there(tmp_path, scans):
    path = tmp_path / "run.bag"
    record(COURSE.model_copy(update={"stride": 4}), path)
    kept = read(path, "/velodyne_points")
    assert [stamp_ns(message.header) for _, message in kept] == [s.stamp for s in scans[::4]]
    assert [len(message.data) for _, message in kept] == [22 * len(s) for s in scans[::4]]
    assert len(read(path, "/gt_poses")) == len(scans) + 1
