import numpy as np
import pytest
import rec
from pydantic import ValidationError

from adaptune import files
from adaptune.geometry import to_pose
from adaptune.recording import SequenceConfig
from adaptune.recording.recording import check_sequence, open_sequence
from adaptune.strict import ConfigurationError
from adaptune.trajectory import Trajectory, write_kitti, write_tum
from offline.config import load_study


def test_paths_are_of_the_studys_folder_and_know_variables(tmp_path, monkeypatch):
    monkeypatch.setenv("RECORDINGS", "/recordings")
    config = SequenceConfig.model_validate(
        {"bag": ["a.bag", "${RECORDINGS}/b.bag"], "reference": "truth/a.tum"},
        context={"folder": tmp_path},
    )
    assert config.bag == (str(tmp_path / "a.bag"), "/recordings/b.bag")
    assert config.reference == str(tmp_path / "truth" / "a.tum")
    with pytest.raises(ValidationError, match="variable NOT_THERE is not set"):
        SequenceConfig(bag="${NOT_THERE}/a.bag")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({}, "give one of bag, kitti, folder, evalio, not none"),
        ({"kitti": "b", "points": "/p"}, "`points` names a topic of a bag; kitti has none"),
        ({"bag": "a", "start": 3, "stop": 2}, r"start \(3\) must be less than stop \(2\)"),
        ({"bag": "a", "compensate": "gyro"}, "needs `imu`"),
        ({"bag": "a", "extrinsic": [1, 2, 3, 0, 0, 0, 0]}, "has not length 1"),
        ({"bag": "a", "extrinsic": np.diag([1, 1, -1, 1]).tolist()}, "not a rotation"),
        ({"bag": "a", "topic": "/p"}, "Extra inputs"),
    ],
)
def test_mistakes_are_told(given, message):
    with pytest.raises(ValidationError, match=message):
        SequenceConfig(**given)


def test_the_two_ways_to_write_a_pose_agree():
    T = to_pose((1.0, 2.0, 3.0, 0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    np.testing.assert_allclose(to_pose(tuple(map(tuple, T.tolist()))), T, atol=1e-15)
    np.testing.assert_allclose(to_pose(tuple(map(tuple, T[:3].tolist()))), T, atol=1e-15)
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def tum(path, seconds, start):
    T = np.tile(np.eye(4), (len(seconds), 1, 1))
    T[:, 0, 3] = seconds
    write_tum(path, Trajectory(start + np.rint(np.array(seconds) * 1e9).astype(np.int64), T))
    return str(path)


def test_a_reference_is_moved_to_the_lidar_and_its_clock(tmp_path):
    bag = str(rec.drive(tmp_path / "a.bag"))
    reference = tum(tmp_path / "a.tum", [0, 1, 2], rec.START - 5 * 10**9)
    extrinsic = [0, 0, 2, 0, 0, 1, 0]  # 2 m above, looking back
    sequence = open_sequence(
        SequenceConfig(bag=bag, reference=reference, extrinsic=extrinsic, clock_offset=5)
    )
    trajectory = sequence.reference()
    T = trajectory.at(np.array([rec.START + 500_000_000]))[0]
    np.testing.assert_allclose(T[:3, 3], [0.5, 0, 2])
    np.testing.assert_allclose(T[:3, 0], [-1, 0, 0], atol=1e-12)


def test_what_would_fail_later_is_found_at_once(tmp_path):
    bag = rec.drive(tmp_path / "a.bag")
    write_tum(tmp_path / "late.tum", at(rec.START + 10**12, 3))
    write_kitti(tmp_path / "short.txt", np.tile(np.eye(4), (3, 1, 1)))
    study = tmp_path / "study.yaml"
    for entry, told in [
        ({"start": 100.0}, r"start = 100 s is beyond its end, it lasts 2\.0 s"),
        ({"reference": "/poses", "clock_offset": 1e4}, "set `clock_offset` to the seconds"),
        ({"reference": str(tmp_path / "late.tum")}, "set `clock_offset` to the seconds"),
        ({"reference": str(tmp_path / "short.txt")}, "3 poses without stamps do not go with 20"),
    ]:
        for _ in range(2):  # before it is in the cache, and after
            data = {
                "odometry": {"name": "gicp"},
                "sequences": {"yard": {"bag": str(bag)} | entry},
                "training": ["yard"],
            }
            study.write_text(files.dump(data))
            with pytest.raises(ConfigurationError, match=rf"line \d+: sequences\.yard: .*{told}"):
                load_study(study)
            list(open_sequence(SequenceConfig(bag=str(bag))))
    check_sequence(SequenceConfig(bag=str(bag), reference="/poses", start=1.5))


def at(stamp, n):
    return Trajectory(stamp + np.arange(n) * 10**8, np.tile(np.eye(4), (n, 1, 1)))
