import numpy as np
import pytest
import rec
from pydantic import ValidationError
from rooms import along_x, write_kitti

from adaptune._system import yaml12
from adaptune._system.strict import ConfigurationError
from adaptune.geometry import to_pose
from adaptune.odometry.program import program_input
from adaptune.recording import SequenceConfig
from adaptune.recording.config import part_name, read_part
from adaptune.recording.recording import RecordedSequence, open_sequence
from adaptune.trajectory import Trajectory, write_tum
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
        ({}, "give one of bag, kitti, folder, not none"),
        ({"kitti": "b", "points": "/p"}, "`points` is for a bag; kitti has none"),
        ({"bag": "a", "start": 3, "stop": 2}, r"start \(3\) must be less than stop \(2\)"),
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


def test_a_reference_is_moved_to_the_lidar_and_its_clock(tmp_path):
    bag, reference = str(rec.drive(tmp_path / "a.bag")), tmp_path / "a.tum"
    stamps = rec.START + np.arange(-5, -2) * 10**9
    write_tum(reference, Trajectory(stamps, along_x([0, 1, 2])))
    given = {"reference": str(reference), "clock_offset": 5}
    given["extrinsic"] = [0, 0, 2, 0, 0, 1, 0]  # 2 m above, looking back
    trajectory = open_sequence(SequenceConfig(bag=bag, **given)).reference()
    T = trajectory.at(np.array([rec.START + 500_000_000]))[0]
    np.testing.assert_allclose(T[:3, 3], [0.5, 0, 2])
    np.testing.assert_allclose(T[:3, 0], [-1, 0, 0], atol=1e-12)


def test_what_would_fail_later_is_found_at_once(tmp_path):
    bag = rec.drive(tmp_path / "a.bag")
    stamps = rec.START + 10**12 + np.arange(3) * 10**8
    write_tum(tmp_path / "late.tum", Trajectory(stamps, along_x([0, 0, 0])))
    write_kitti(tmp_path / "short.txt", along_x([0, 0, 0]))
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
            study.write_text(yaml12.dump(data))
            with pytest.raises(ConfigurationError, match=rf"line \d+: sequences\.yard: .*{told}"):
                load_study(study)
            list(open_sequence(SequenceConfig(bag=str(bag))))
    RecordedSequence(SequenceConfig(bag=str(bag), reference="/poses", start=1.5)).check()


@pytest.mark.parametrize(
    ("text", "part", "name"),
    [
        ("0-60%", (0.0, 0.6), "a_0-60"),
        ("60-100%", (0.6, 1.0), "a_60-100"),
        (" 12.5 - 50 % ", (0.125, 0.5), "a_12.5-50"),
        ([0.25, 0.5], (0.25, 0.5), "a_25-50"),
    ],
)
def test_parts_are_read_and_named(text, part, name):
    assert read_part(text) == part
    assert part_name("a", part) == name


@pytest.mark.parametrize("text", ["abc", "60-0%", "0-120%", "", 60, [0, "a"]])
def test_what_is_no_part_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="as in 0-60%"):
        read_part(text)
    with pytest.raises(ValidationError, match="as in 0-60%"):
        SequenceConfig(bag="a.bag", part=text or "")


def tenths(sequence):
    return [round((scan.stamp - rec.START) / 1e8) for scan in sequence]


def test_the_parts_of_a_bag_are_the_bag(tmp_path):
    bag = str(rec.drive(tmp_path / "a.bag"))
    for _ in range(2):  # read, and from the cache
        first = open_sequence(SequenceConfig(bag=bag, part="0-60%"))
        second = open_sequence(SequenceConfig(bag=bag, part="60-100%"))
        begin, end = tenths(first), tenths(second)
        assert begin + end == list(range(20))
        assert len(begin) == pytest.approx(12, abs=1)
    assert first.n_messages == pytest.approx(12, abs=1)
    RecordedSequence(SequenceConfig(bag=bag, part="0-60%")).check()
    within = open_sequence(SequenceConfig(bag=bag, start=0.5, stop=1.5, part="50-100%"))
    assert tenths(within) == list(range(10, 15))


def test_a_program_reads_the_part_alone(tmp_path):
    bag = rec.drive(tmp_path / "a.bag")
    for part, own in ((None, True), ("0-60%", False)):
        config = SequenceConfig(bag=str(bag), reference="/poses", part=part)
        folder = tmp_path / "inputs" / str(part)
        sequence = open_sequence(config)
        found = program_input(sequence, config, {}, folder, "bag")
        assert (found.path == bag) is own
        # What its poses may be later than its stamps.
        assert found.span == pytest.approx(1e8, abs=10)
        assert found.stamps.tolist() == [scan.stamp for scan in sequence]
