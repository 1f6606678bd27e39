from pathlib import Path
from typing import Any

import numpy as np
import pytest
from inspected import entry, inspection_text, texts
from rosbags.highlevel import AnyReader
from small_bag import START, STORE, bad_cloud, cloud, drive, header, pose, write
from typer.testing import CliRunner

from adaptune import files
from adaptune.commands.cli import app
from adaptune.recording import SequenceConfig, SequenceError
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence
from offline.config import load_study


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))


def test_a_sound_bag_has_all_it_needs_and_an_entry_that_opens(tmp_path: Path) -> None:
    seconds = [0.1 * i for i in range(10)]
    bag = drive(tmp_path / "my drive.bag", seconds, [(s, 40 * s) for s in seconds])
    inspection = inspect(bag)
    points = next(topic for topic in inspection.topics if topic.name == "/points")
    assert points.count == 10
    assert points.rate == pytest.approx(10)
    assert points.gap == pytest.approx(0.1)
    assert inspection.layout[3] == ("time", "float32", 12)
    assert inspection.scan is not None
    assert len(inspection.scan.scan) == 195
    assert inspection.scan.recorded == 200
    assert inspection.scan.span == pytest.approx(0.1)
    assert inspection.faults == ()
    assert not inspection.missing["offline"]
    assert not inspection.missing["motion compensation"]
    ((name, config),) = entry(inspection).items()
    assert name == "my_drive"
    sequence = open_sequence(config)
    assert len(list(sequence)) == 10
    assert sequence.reference() is not None
    text = inspection_text(inspection)
    for expected in ("/points", "195 points of 200", "10.00 Hz", "36.0 m in 0.9 s", str(bag)):
        assert expected in text.replace("\n", "")
    assert "read: all 20 messages" in text
    assert text.count("has all it needs") == 4


@pytest.mark.parametrize(
    ("stamps", "poses", "expected"),
    [
        ([0, 0.1, 0.1, 0.3], [], "/points: 1 of 4 stamps repeat the one before"),
        ([0, 0.2, 0.1, 0.3], [], "/points: 1 of 4 stamps go back in time"),
        ([0, 0, 0], [], "/points: all 3 stamps are the same"),
        ([0, 0.1, 0.2, 2.3, 2.4], [], "/points: 1 gaps, the longest of 2.10 s"),
        ([-100.0, -99.9, -99.8], [], "/points: its clock is 100.000 s behind the recorder's"),
        ([0, 0.1, 90, 0.3], [], "/points: 1 stamps leap by more than 5 s"),
        ([0, 0.1], [(0, 0), (0.1, 0), (0.2, 1)], "repeats the pose before it 1 times"),
        ([0, 0.1], [(0, 0), (0.1, 500)], "the reference jumps 1 times"),
        ([0, 0.1], [(0, 0), (5, 1)], "the reference has 1 gaps beyond 1 s, the longest of 5.00 s"),
        ([0, 0.1], [(0, 0), (0.1, 9)], "the reference is 9.0 m long: set `sub_trajectory`"),
        ([0, 9], [(0, 0), (4, 60)], "the scans outside get no label"),
        ([0, 0.1], [(0, 0)], "the reference holds a single pose"),
        ([0, 0.1], [(0, 2), (0.1, 2)], "the reference stands still"),
        ([0, 0.1], [(50, 0), (60, 0)], "set `clock_offset`"),
    ],
)
def test_faults_are_reported_with_what_to_do(
    tmp_path: Path, stamps: list[float], poses: list[tuple[float, float]], expected: str
) -> None:
    inspection = inspect(drive(tmp_path / "a.bag", stamps, poses))
    assert any(expected in text for text in texts(inspection)), texts(inspection)
    text = inspection_text(inspection, width=1000)
    assert expected[:20] in text
    assert "offline: has all it needs" not in text
    if expected.startswith("/points"):
        assert "has all it needs" not in text


@pytest.mark.parametrize(
    ("poses", "lacking"),
    [
        ([(0, 2), (0.1, 2)], "a reference that moves"),
        ([(0, 0)], "a reference that moves"),
        ([(50, 0), (60, 9)], "a reference of the same time"),
    ],
)
def test_a_reference_that_does_not_serve_is_missing(
    tmp_path: Path, poses: list[tuple[float, float]], lacking: str
) -> None:
    inspection = inspect(drive(tmp_path / "a.bag", [0, 0.1], poses))
    assert inspection.missing["offline"] == (lacking,)
    assert inspection.missing["online"] == ()
    text = inspection_text(inspection)
    assert f"offline: lacks {lacking}" in text
    assert "online: has all it needs" in text


def test_without_a_reference_nothing_is_missing(tmp_path: Path) -> None:
    inspection = inspect(drive(tmp_path / "a.bag", [0, 0.1], []))
    assert not inspection.missing["offline"]
    text = inspection_text(inspection, width=1000)
    assert "reference: none; adaptune estimates one from the scans" in text
    assert "offline: has all it needs" in text
    assert "# reference: a topic, or a TUM, KITTI or EuRoC file; estimated if left out" in text


@pytest.mark.parametrize("of", ["NaN", "zero", "far", "few"])
def test_clouds_without_valid_points_are_reported(tmp_path: Path, of: str) -> None:
    times = [START + i * 10**8 for i in range(5)]
    bad = [("/points", t, bad_cloud(t, of)) for t in times]
    inspection = inspect(write(tmp_path / "all.bag", bad))
    assert "all 5 clouds hold fewer than 20 valid points" in " ".join(texts(inspection))
    assert inspection.missing["online"] == ("clouds with points",)
    some = [("/points", t, cloud(t)) for t in times[:4]] + bad[4:]
    inspection = inspect(write(tmp_path / "some.bag", some))
    assert "1 of 5 clouds hold fewer than 20 valid points" in " ".join(texts(inspection))
    assert inspection.missing["online"] == ()
    assert "online: can run, but see" in inspection_text(inspection)


def test_a_single_cloud_is_not_enough(tmp_path: Path) -> None:
    inspection = inspect(write(tmp_path / "a.bag", [("/points", START, cloud(START))]))
    assert "/points: holds a single cloud" in " ".join(texts(inspection))
    assert inspection.missing["online"] == ("more than one cloud",)


def test_messages_that_do_not_decode_are_reported(tmp_path: Path) -> None:
    times = [START + i * 10**8 for i in range(5)]
    given = [
        ("/points", t, (bad_cloud(t, "cut") if i == 3 else cloud(t))) for i, t in enumerate(times)
    ]
    inspection = inspect(write(tmp_path / "a.bag", given))
    (text,) = texts(inspection)
    assert "/points: 1 of 5 messages do not decode, the first at 0.3 s" in text
    assert "set `stop` before it" in text
    assert inspection.missing["online"] == ("point clouds that decode",)
    ((_, config),) = entry(inspection).items()
    assert len(list(open_sequence(config.model_copy(update={"stop": 0.3})))) == 3


def test_a_bag_that_is_damaged_in_the_middle_says_so(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0.1 * i for i in range(5)], [])
    data = bag.read_bytes()
    at = [i for i in range(len(data)) if data.startswith(b"op=\x02", i)][3]
    bag.write_bytes(data[:at] + b"op=\x09" + data[at + 4 :])
    inspection = inspect(bag, deep=True)
    assert "the rest cannot be read" in " ".join(texts(inspection))
    assert inspection.missing["online"] == ("a recording that can be read to its end",)
    text = inspection_text(inspection)
    assert "read: 3 of 5 messages" in text
    assert "--deep" not in text


def test_poses_that_are_not_finite_are_counted(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0, 0.1], [(0, 0), (0.05, np.nan), (0.1, 30)])
    assert "/poses: 1 of 3 poses are not finite" in " ".join(texts(inspect(bag)))
    bag = drive(tmp_path / "b.bag", [0, 0.1], [(0, np.nan), (0.1, np.nan)])
    assert inspect(bag).missing["offline"] == ("a reference trajectory",)


def test_the_last_path_is_the_reference(tmp_path: Path) -> None:
    messages: list[Any] = []
    for i in range(5):
        t = START + i * 10**8
        poses = [pose(START + j * 10**8, (4.0 + i) * j) for j in range(i + 1)]
        path = STORE.types["nav_msgs/msg/Path"](header(t), poses)
        messages += [("/points", t, cloud(t)), ("/path", t, path)]
    inspection = inspect(write(tmp_path / "a.bag", messages))
    assert inspection.faults == ()
    assert inspection.reference is not None
    assert inspection.reference.T_world_sensor[:, 0, 3].tolist() == [0, 8, 16, 24, 32]


def test_an_imu_that_is_not_finite_is_reported(tmp_path: Path) -> None:
    types = STORE.types
    q, none = types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1), np.zeros(9)
    messages: list[Any] = [("/points", t, cloud(t)) for t in (START, START + 10**8)]
    for z in (9.81, np.nan):
        v = types["geometry_msgs/msg/Vector3"](0, 0, z)
        imu = types["sensor_msgs/msg/Imu"](header(START), q, none, v, none, v, none)
        messages.append(("/imu", START, imu))
    inspection = inspect(write(tmp_path / "a.bag", messages))
    assert "/imu: 1 of 2 messages do not decode" in " ".join(texts(inspection))
    text = inspection_text(inspection, width=1000)
    assert "online: has all it needs" in text
    assert "motion compensation: can run, but see" in text


def test_poses_that_do_not_decode_are_reported(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0, 0.1], [(0, 0), (0.1, 30)])
    with AnyReader([bag]) as reader:
        (sound,) = {c.topic: d for c, _, d in reader.messages() if c.topic == "/poses"}.values()
    damaged = sound[:12] + b"\xff" * 4 + sound[16:]  # the length of the frame's name
    bag.write_bytes(bag.read_bytes().replace(sound, damaged))
    inspection = inspect(bag)
    assert "/poses: 1 of 2 messages do not decode" in " ".join(texts(inspection))
    assert inspection.missing["offline"] == ("a reference that decodes", "a reference that moves")
    assert inspection.missing["online"] == ()


def test_the_end_of_a_scan_is_spoken_of_only_if_points_have_times(tmp_path: Path) -> None:
    timed, timeless = cloud(START), cloud(START)
    timeless.fields = timeless.fields[:3]
    for message, hint in ((timed, True), (timeless, False)):
        bag = write(tmp_path / f"{hint}.bag", [("/points", START, message)])
        assert ("# stamp: end" in inspect(bag).entry) == hint


def test_what_is_missing_is_reported(tmp_path: Path) -> None:
    inspection = inspect(write(tmp_path / "a.bag", [("/poses", START, pose(START, 0))]))
    assert inspection.missing["online"] == ("point clouds that can be read",)
    assert inspection.scan is None
    inspection_text(inspection)


def test_a_cloud_that_cannot_be_decoded_is_a_problem_not_a_crash(tmp_path: Path) -> None:
    broken = cloud(START)
    broken.fields = broken.fields[:2]
    inspection = inspect(write(tmp_path / "a.bag", [("/points", START, broken)]))
    assert inspection.scan is None
    assert any("no field z; there is x, y" in text for text in texts(inspection))


def test_a_file_of_a_folder_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    for i in range(100):
        np.save(tmp_path / f"{i}.npy", np.full((30, 3), i + 1.0, np.float32))
    assert inspect(tmp_path).faults == ()
    assert "sample of 40 of 100" in inspection_text(inspect(tmp_path), width=1000)
    (tmp_path / "99.npy").write_bytes(b"no array")
    np.save(tmp_path / "50.npy", np.zeros((30, 3), np.float32))
    inspection = inspect(tmp_path, deep=True)
    assert inspection.n_read == (100, 100)
    assert inspection.missing["online"] == ("point clouds that decode",)
    undecoded, empty = texts(inspection)
    assert "1 of 100 messages do not decode, the first at 9.9 s" in undecoded
    assert "99.npy: cannot be read as a scan" in undecoded
    assert "1 of 99 clouds hold fewer than 20 valid points" in empty


def test_the_poses_of_a_kitti_folder_are_inspected(tmp_path: Path) -> None:
    (tmp_path / "velodyne").mkdir()
    for i in range(20):
        np.full((30, 4), i + 1.0, "<f4").tofile(tmp_path / f"velodyne/{i:06}.bin")
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(20)))
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "poses.txt").write_text(KITTI)
    inspection = inspect(tmp_path)
    assert inspection.faults == ()
    assert not inspection.missing["offline"]
    ((_, config),) = entry(inspection).items()
    assert config.kitti == str(tmp_path)
    (tmp_path / "poses.txt").write_text(KITTI.splitlines()[0] + "\n")
    assert inspect(tmp_path).missing["offline"] == ("a reference trajectory",)


def test_files_that_are_no_recording_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("text")
    for path, message in [
        (tmp_path / "none.bag", "there is no such file or folder"),
        (tmp_path / "a.yaml", "not a bag"),
        (tmp_path, "holds no scan"),
    ]:
        with pytest.raises(SequenceError, match=message):
            inspect(path)


POSES = [(0.1 * i, 3.0 * i) for i in range(20)]
TUM = "".join(f"{s:.3f} {x} 0 0 0 0 0 1\n" for s, x in POSES)
KITTI = "".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for _, x in POSES)
EUROC = "#timestamp\n" + "".join(f"{round(s * 1e9)},{x},0,0,1,0,0,0\n" for s, x in POSES)


@pytest.mark.parametrize(
    ("name", "content", "timed"),
    [("a.tum", TUM, True), ("a.txt", TUM, True), ("a.txt", KITTI, False), ("a.csv", EUROC, True)],
)
def test_files_of_poses_are_inspected(tmp_path: Path, name: str, content: str, timed: bool) -> None:
    (tmp_path / name).write_text(content)
    inspection = inspect(tmp_path / name)
    (topic,) = inspection.topics
    assert topic.count == 20
    assert topic.rate == (pytest.approx(10) if timed else None)
    assert topic.gap == (pytest.approx(0.1) if timed else None)
    assert texts(inspection) == []
    text = inspection_text(inspection, width=1000)
    assert (
        "reference: 20 poses, 57.0 m in 1.9 s" if timed else "reference: 20 poses, 57.0 m\n"
    ) in text
    bag = drive(tmp_path / "a.bag", [s for s, _ in POSES], [])
    given = files.Document(inspection.entry).data
    config = SequenceConfig(bag=str(bag), clock_offset=START * 1e-9 if timed else 0.0, **given)
    sequence = open_sequence(config)
    assert sequence.reference() is not None


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (TUM.splitlines()[0], "holds a single pose"),
        ("0 1 1 1 0 0 0 1\n1 1 1 1 0 0 0 1\n", "stands still"),
        (TUM + "3 9999 0 0 0 0 0 1\n", "jumps 1 times"),
        (TUM + "9 70 0 0 0 0 0 1\n", "1 gaps beyond 1 s, the longest of 7.10 s"),
    ],
)
def test_faults_of_poses_are_reported(tmp_path: Path, content: str, expected: str) -> None:
    (tmp_path / "a.tum").write_text(content)
    assert expected in " ".join(texts(inspect(tmp_path / "a.tum")))


def test_a_study_of_the_printed_lines_opens_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds = [0.1 * i for i in range(5)]
    for folder in ("data", "studies"):
        (tmp_path / folder).mkdir()
    drive(tmp_path / "data/a.bag", seconds, [])
    (tmp_path / "data/a.txt").write_text("".join(KITTI.splitlines(keepends=True)[:5]))
    monkeypatch.chdir(tmp_path / "data")
    lines = inspect(Path("a.bag")).entry + "    " + inspect(Path("a.txt")).entry
    study = tmp_path / "studies/a.yaml"
    study.write_text(f"odometry: {{name: gicp}}\n{lines}training: [a]\ntest: []\n")
    monkeypatch.chdir(tmp_path / "studies")
    sequence = open_sequence(load_study(study).config.sequences["a"])
    assert len(list(sequence)) == 5
    assert sequence.reference() is not None


def test_folders_are_inspected_too(tmp_path: Path) -> None:
    for i in range(4):
        np.save(tmp_path / f"{i}.npy", np.ones((30, 3), np.float32) * (i + 1))
    inspection = inspect(tmp_path)
    assert inspection.topics[0].count == 4
    assert inspection.topics[0].rate == pytest.approx(10)
    assert not inspection.faults
    assert len(list(open_sequence(next(iter(entry(inspection).values()))))) == 4


def test_the_command_reads_all(tmp_path: Path) -> None:
    bag = drive(tmp_path / "a.bag", [0, 0.1], [])
    done = CliRunner().invoke(app, ["inspect", "--deep", str(bag)])
    assert done.exit_code == 0, done.output
    assert "read: all 2 messages" in done.output
