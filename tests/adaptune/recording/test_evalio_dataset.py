import numpy as np
import pytest
import rec

from adaptune.recording import SequenceConfig, SequenceError
from adaptune.recording.evalio import EvalioFiles
from adaptune.recording.recording import open_sequence


@pytest.fixture
def datasets(tmp_path):
    datasets = pytest.importorskip("evalio.datasets", reason="evalio is not installed")
    datasets.set_data_dir(tmp_path)
    return datasets


@pytest.mark.usefixtures("datasets")
def test_names_that_evalio_does_not_know_or_have():
    with pytest.raises(SequenceError, match="evalio knows no such sequence"):
        open_sequence(SequenceConfig(evalio="botanic_garden/none"))
    with pytest.raises(SequenceError, match="evalio dl botanic_garden/b1005_00"):
        open_sequence(SequenceConfig(evalio="botanic_garden/b1005_00"))


def test_a_data_set_is_read_as_evalio_reads_it(tmp_path, datasets):
    folder = tmp_path / "botanic_garden" / "b1005_00"
    folder.mkdir(parents=True)
    messages = []
    for i, points in enumerate(rec.scans(3, 200)):
        raw = rec.velodyne(points)
        # Stamped at the end, as this data set is.
        raw["time"] = np.linspace(-0.1, 0, len(raw))
        stamp = rec.START + (i + 1) * 10**8
        messages.append(("/velodyne_points", stamp, rec.cloud(raw, stamp, rec.ROS1)))
        measured = rec.imu(stamp, (0, 0, 1), (0, 0, 1), rec.ROS1)
        messages.append(("/imu/data", stamp, measured))
    rec.write_bag(folder / "1005_00.bag", messages)
    seconds = [
        f"{(rec.START + i * 10**8) // 10**9}.{(rec.START + i * 10**8) % 10**9:09d}" for i in (0, 3)
    ]
    (folder / "1005_00_GT_output.txt").write_text(
        "".join(f"{s} {i} 0 0 0 0 0 1\n" for i, s in enumerate(seconds))
    )

    sequence = open_sequence(SequenceConfig(evalio="botanic_garden/b1005_00", imu={}))

    dataset = datasets.get_sequence("botanic_garden/b1005_00")
    scans = list(sequence)
    assert sequence.n_messages == len(scans) == 3
    for scan, measurement in zip(scans, dataset.lidar(), strict=True):
        assert abs(scan.stamp - measurement.stamp.to_nsec()) < 1000
        theirs = np.array(measurement.to_vec_positions())
        times = np.array(measurement.to_vec_stamps())[(theirs != 0).any(axis=1)]
        theirs = theirs[(theirs != 0).any(axis=1)]
        # evalio orders points by rows.
        ours, theirs = np.lexsort(scan.points.T), theirs[(order := np.lexsort(theirs.T))]
        np.testing.assert_allclose(scan.points[ours], theirs)
        np.testing.assert_allclose(scan.times[ours], times[order], atol=1e-6)
    # Data sets that are no bags are converted by evalio itself.
    for frame, scan in zip(EvalioFiles(dataset).frames(), scans, strict=True):
        converted = frame.load()
        assert abs(converted.stamp - scan.stamp) < 1000
        assert sorted(converted.points[:, 0]) == sorted(scan.points[:, 0])
        np.testing.assert_allclose(np.sort(converted.times), np.sort(scan.times), atol=1e-6)
    reference, imu = sequence.reference(), sequence.imu()
    # This data set's poses are the LiDAR's own.
    np.testing.assert_allclose(reference.T_world_sensor[1][:3, 3], [1, 0, 0], atol=1e-9)
    assert len(imu) == 3
    np.testing.assert_allclose(
        np.linalg.inv(imu.T_sensor_imu)[:3, 3], [0.058487, 0.008404, 0.168916], atol=1e-5
    )
