import runpy
from pathlib import Path

import fuzz
import numpy as np
import pytest
import rec
from rosbags.highlevel import AnyReader
from small_bag import START, bad_cloud, cloud, drive, entry, inspection_text, pose, texts

from adaptune._system import yaml12
from adaptune.errors import AdaptuneError
from adaptune.recording import SequenceConfig
from adaptune.recording import inspect as module
from adaptune.recording import recording as module_recording
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence
from offline.config import load_study


def test_a_sound_bag_has_all_it_needs_and_an_entry_that_opens(tmp_path):
    seconds = [0.1 * i for i in range(10)]
    bag = drive(tmp_path / "my drive.bag", seconds, [(s, 40 * s) for s in seconds])
    inspection = inspect(bag)
    points = inspection.topics["/points"]
    assert (points.count, points.rate, points.gap) == pytest.approx((10, 10, 0.1))
    assert inspection.fields[3] == "time"
    assert len(inspection.scan) == 195
    assert inspection.findings == []
    assert not inspection.missing["offline"]
    assert not inspection.missing["motion compensation"]
    ((name, config),) = entry(inspection).items()
    assert name == "my_drive"
    sequence = open_sequence(config)
    assert len(list(sequence)) == 10
    assert sequence.reference() is not None
    text = inspection_text(inspection)
    for expected in (
        "/points",
        "195 points",
        "times spanning 0.1000 s",
        "10.00 Hz",
        "36.0 m in 0.9 s",
        str(bag),
    ):
        assert expected in text.replace("\n", "")
    assert "read: all 20 messages" in text
    assert text.count("has all it needs") == 3


@pytest.mark.parametrize(
    ("stamps", "poses", "expected"),
    [
        ([0, 0.2, 0.1, 0.3], [], "/points: 1 of 4 stamps do not come after the one before"),
        ([0, 0, 0], [], "/points: 2 of 3 stamps do not come after the one before"),
        ([0, 0.1, 0.2, 2.3, 2.4], [], "/points: 1 gaps, the longest of 2.10 s"),
        ([0, 0.1], [(0, 0), (0.1, 500)], "the reference jumps by up to 500 m"),
        ([0, 0.1], [(0, 0), (5, 1)], "1 of 1 gaps of the reference are longer than max_gap = 1 s"),
        ([0, 9], [(0, 0), (4, 60)], "the scans outside get no label"),
        ([0, 0.1], [(0, 0)], "the reference holds a single pose"),
        ([0, 0.1], [(0, 2), (0.1, 2)], "the reference stands still"),
        ([0, 0.1], [(50, 0), (60, 0)], "set `clock_offset`"),
    ],
)
def test_faults_are_reported_with_what_to_do(tmp_path, stamps, poses, expected):
    inspection = inspect(drive(tmp_path / "a.bag", stamps, poses))
    assert any(expected in text for text in texts(inspection)), texts(inspection)
    text = inspection_text(inspection, width=1000)
    assert expected[:20] in text
    assert "offline: has all it needs" not in text
    if expected.startswith("/points"):
        assert "has all it needs" not in text


@pytest.mark.parametrize("of", ["NaN", "zero", "far", "few"])
def test_clouds_without_valid_points_are_reported(tmp_path, of):
    times = [START + i * 10**8 for i in range(5)]
    bad = [("/points", t, bad_cloud(t, of)) for t in times]
    inspection = inspect(rec.write_bag(tmp_path / "all.bag", bad))
    assert "all 5 clouds hold fewer than 20 valid points" in " ".join(texts(inspection))
    assert inspection.missing["online"] == ("clouds with points",)
    some = [("/points", t, cloud(t)) for t in times[:4]] + bad[4:]
    inspection = inspect(rec.write_bag(tmp_path / "some.bag", some))
    assert "1 of 5 clouds hold fewer than 20 valid points" in " ".join(texts(inspection))
    assert inspection.missing["online"] == ()
    assert "online: can run, but see" in inspection_text(inspection)


@pytest.mark.usefixtures("cache_folder")
def test_every_command_tells_what_a_look_at_the_clouds_shows(tmp_path, caplog):
    times, messages = [START + i * 10**8 for i in range(40)], []
    for i, when in enumerate(times):
        raw = cloud(when).data.view("<f4").reshape(-1, 4).copy()
        raw[5:85, :3] = 1e5 if i else raw[5:85, :3]
        raw[:, :3] *= 0.01 if 10 <= i < 20 else 1.0
        messages += [("/points", t, rec.cloud(raw.view(cloud_dtype(raw)).ravel(), t, rec.ROS1))
                     for t in (when, when + 1000)[: 1 + i % 2]]  # fmt: skip
    inspection = inspect(rec.write_bag(tmp_path / "a.bag", messages))
    shown = [text.removeprefix("/points: ") for text in texts(inspection)]
    marks, repeated, covered = [text for text in shown if "stamps" not in text]
    assert marks.startswith("40% of the points mark rays that did not come back")
    assert repeated.startswith("20 of 60 clouds repeat the points of the one before")
    assert covered.startswith("10 of 60 clouds lie within 1 m")
    ((_, config),) = entry(inspection).items()
    for _ in range(2):  # from the bag, and from the cache
        module_recording._warn.cache_clear()
        caplog.clear()
        assert len(list(open_sequence(config))) == 40
        assert [text in caplog.text for text in (marks, repeated, covered)] == 3 * [True]


def cloud_dtype(raw):
    return np.dtype([(name, raw.dtype) for name in ("x", "y", "z", "time")])


def framed(message, frame):
    message.header.frame_id = frame
    return message


def test_clouds_of_two_frames_or_of_a_map_are_named(tmp_path):
    times = [START + i * 10**8 for i in range(20)]
    two = [("/points", t, framed(cloud(t), "ab"[i % 2])) for i, t in enumerate(times)]
    inspection = inspect(rec.write_bag(tmp_path / "two.bag", two))
    assert "holds clouds of 'a', 'b'; name one of these frames as `frame`" in texts(inspection)[0]
    assert inspection.missing["offline"] == ("clouds of one frame",)
    for frame, moves in (("lidar", False), ("map", True), ("map", False)):
        messages = []
        for i, t in enumerate(times):
            message = framed(cloud(t), frame)
            message.data.view("<f4").reshape(-1, 4)[:, 0] += 2.0 * i * moves
            messages += [("/points", t, message), ("/poses", t, pose(t, 2.0 * i))]
        inspection = inspect(rec.write_bag(tmp_path / f"{frame}_{moves}.bag", messages))
        lacks = moves * ("clouds in the sensor's frame",)
        assert inspection.missing["offline"] == lacks, texts(inspection)


def test_messages_that_do_not_decode_are_reported(tmp_path):
    times = [START + i * 10**8 for i in range(5)]
    given = [("/points", t, cloud(t)) for t in times]
    given[3] = ("/points", times[3], bad_cloud(times[3], "cut"))
    inspection = inspect(rec.write_bag(tmp_path / "a.bag", given))
    (text,) = texts(inspection)
    assert "/points: 1 of 5 messages do not decode, the first at 0.3 s" in text
    assert "set `stop` before it" in text
    assert inspection.missing["online"] == ("point clouds that decode",)
    ((_, config),) = entry(inspection).items()
    assert len(list(open_sequence(config.model_copy(update={"stop": 0.3})))) == 3


def drive_of(path, span=0.1, begin=0.0, kind="<f4"):
    """Ten scans whose times begin at `begin`."""
    messages = []
    for i, first in enumerate(np.broadcast_to(begin, 10)):
        raw = np.zeros(200, [*((name, "<f4") for name in "xyz"), ("time", kind)])
        raw["x"], raw["y"], raw["z"] = np.random.default_rng(i).normal(0, 10, (3, 200))
        raw["time"] = first + np.linspace(0, span, 200)
        stamp = START + i * 10**8
        messages.append(("/points", stamp, rec.cloud(raw, stamp, rec.ROS1)))
    return rec.write_bag(path, messages)


@pytest.mark.parametrize(
    ("given", "expected", "stage", "runs"),
    [
        ({"span": 1.0}, "they look like shares of a turn: write `time_unit: turn`", "online", 0),
        (
            {"span": 1e5, "kind": "<u4"},
            "scans come every 0.1 s; write `time_unit: us`",
            "online",
            0,
        ),
        ({"span": 100.0}, "write `time_unit: ms`", "online", 0),
        ({"span": 0.0}, "the same time", "motion compensation", 0),
        ({"span": 0.0}, "the same time", "online", 10),
        ({"begin": 0.3}, "write `stamp: first_point`", "online", 0),
    ],
)
def test_what_breaks_a_convention_is_named(tmp_path, given, expected, stage, runs):
    inspection = inspect(drive_of(tmp_path / "a.bag", **given))
    assert expected in " ".join(texts(inspection))
    assert (not inspection.missing[stage]) == bool(runs)
    if runs:
        ((_, config),) = entry(inspection).items()
        assert len(list(open_sequence(config))) == runs


def test_stamps_that_shake_against_the_sensor_s_clock_are_named(tmp_path):
    own, shake = 7e8 + 0.1 * np.arange(10), np.random.default_rng(0).uniform(0, 0.04, 10)
    assert texts(inspect(drive_of(tmp_path / "a.bag", begin=own, kind="<f8"))) == []
    (text,) = texts(inspect(drive_of(tmp_path / "b.bag", begin=own + shake, kind="<f8")))
    assert "ms against the sensor's clock; write `stamp: sensor_clock`" in text


def test_a_bag_that_is_damaged_in_the_middle_says_so(tmp_path):
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


def test_an_imu_that_is_not_finite_is_reported(tmp_path):
    messages = [("/points", t, cloud(t)) for t in (START, START + 10**8)]
    messages += [
        ("/imu", START, rec.imu(START, (0, 0, z), (0, 0, z), rec.ROS1)) for z in (9.81, np.nan)
    ]
    inspection = inspect(rec.write_bag(tmp_path / "a.bag", messages))
    assert "/imu: 1 of 2 messages do not decode" in " ".join(texts(inspection))
    text = inspection_text(inspection, width=1000)
    assert "online: has all it needs" in text
    assert "motion compensation: can run, but see" in text


def test_poses_that_do_not_decode_are_reported(tmp_path):
    bag = drive(tmp_path / "a.bag", [0, 0.1], [(0, 0), (0.1, 30)])
    with AnyReader([bag]) as reader:
        (sound,) = {c.topic: d for c, _, d in reader.messages() if c.topic == "/poses"}.values()
    damaged = sound[:12] + b"\xff" * 4 + sound[16:]  # the length of the frame's name
    bag.write_bytes(bag.read_bytes().replace(sound, damaged))
    inspection = inspect(bag)
    assert "/poses: 1 of 2 messages do not decode" in " ".join(texts(inspection))
    assert inspection.missing["offline"] == ("a reference that decodes", "a reference that moves")
    assert inspection.missing["online"] == ()


def test_a_file_of_a_folder_that_cannot_be_read_is_reported(tmp_path):
    for i in range(100):
        np.save(tmp_path / f"{i}.npy", np.full((30, 3), i + 1.0, np.float32))
    assert inspect(tmp_path).findings == []
    assert "sample of 40 of 100" in inspection_text(inspect(tmp_path), width=1000)
    (tmp_path / "99.npy").write_bytes(b"no array")
    np.save(tmp_path / "50.npy", np.zeros((30, 3), np.float32))
    inspection = inspect(tmp_path, deep=True)
    assert inspection.n_read == (100, 99)
    assert inspection.missing["online"] == ("point clouds that decode",)
    undecoded, empty = texts(inspection)
    assert "1 of 100 messages do not decode, the first at 9.9 s" in undecoded
    assert "99.npy: cannot be read as a scan" in undecoded
    assert "1 of 99 clouds hold fewer than 20 valid points" in empty


def test_the_poses_of_a_kitti_folder_are_inspected(tmp_path):
    (tmp_path / "velodyne").mkdir()
    for i in range(20):
        np.full((30, 4), i + 1.0, "<f4").tofile(tmp_path / f"velodyne/{i:06}.bin")
    (tmp_path / "times.txt").write_text("".join(f"{0.1 * i}\n" for i in range(20)))
    (tmp_path / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    (tmp_path / "poses.txt").write_text(KITTI)
    inspection = inspect(tmp_path)
    assert inspection.findings == []
    assert not inspection.missing["offline"]
    ((_, config),) = entry(inspection).items()
    assert config.kitti == str(tmp_path)
    (tmp_path / "poses.txt").write_text(KITTI.splitlines()[0] + "\n")
    assert inspect(tmp_path).missing["offline"] == ("a reference trajectory",)


def test_files_that_are_no_recording_are_refused(tmp_path):
    for name in ("a.yaml", "a.bag", "a.mcap"):
        (tmp_path / name).write_text("<html>Sign in to download</html>\n" * 100)
    (tmp_path / "empty").mkdir()
    for path, message in [
        (tmp_path / "none.bag", "there is no such file or folder"),
        (tmp_path / "a.yaml", "holds XML, JSON or NMEA"),
        (tmp_path / "empty", r"holds no scan \(.*\) and no bag"),
        (tmp_path / "a.bag", "is no bag, whatever"),
        (tmp_path / "a.mcap", "is no bag, whatever"),
    ]:
        with pytest.raises(AdaptuneError, match=message):
            inspect(path)


POSES = [(0.1 * i, 3.0 * i) for i in range(20)]
TUM = "".join(f"{s:.3f} {x} 0 0 0 0 0 1\n" for s, x in POSES)
KITTI = "".join(f"1 0 0 {x} 0 1 0 0 0 0 1 0\n" for _, x in POSES)
EUROC = "#timestamp\n" + "".join(f"{round(s * 1e9)},{x},0,0,1,0,0,0\n" for s, x in POSES)


@pytest.mark.parametrize(
    ("name", "content", "timed"),
    [("a.tum", TUM, True), ("a.txt", TUM, True), ("a.txt", KITTI, False), ("a.csv", EUROC, True)],
)
def test_files_of_poses_are_inspected(tmp_path, name, content, timed):
    (tmp_path / name).write_text(content)
    inspection = inspect(tmp_path / name)
    (topic,) = inspection.topics.values()
    assert topic.count == 20
    assert (topic.rate, topic.gap) == (pytest.approx((10, 0.1)) if timed else (None, None))
    assert texts(inspection) == []
    length = "reference: 20 poses, 57.0 m" + (" in 1.9 s" if timed else "\n")
    assert length in inspection_text(inspection, width=1000)
    bag = drive(tmp_path / "a.bag", [s for s, _ in POSES], [])
    given = yaml12.Document(inspection.entry).data
    config = SequenceConfig(bag=str(bag), clock_offset=START * 1e-9 if timed else 0.0, **given)
    assert open_sequence(config).reference() is not None


def test_a_study_of_the_printed_lines_opens_from_any_folder(tmp_path, monkeypatch):
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


@pytest.fixture
def sampled(monkeypatch):
    """Every recording is too long to be read completely."""
    monkeypatch.setattr(module, "SECONDS", 0.0)


TENTHS = [0.1 * i for i in range(400)]


def long_drive(path, every=1, *, stamps=None, speed=2.0, offset=0.0, cloud=cloud):
    """40 s at 10 Hz, 2 m/s; `every` n-th scan has a pose."""
    messages = []
    for s in TENTHS if stamps is None else stamps:
        when = START + round(s * 1e9)
        messages.append(("/points", when, cloud(when)))
        if round(10 * s) % every == 0:
            messages.append(("/poses", when, pose(when + round(offset * 1e9), speed * s)))
    return rec.write_bag(path, messages)


@pytest.mark.usefixtures("sampled")
@pytest.mark.parametrize("every", [1, 10, 100])
def test_a_sound_bag_is_sound_in_a_sample(tmp_path, every):
    inspection = inspect(long_drive(tmp_path / "a.bag", every))
    assert inspection.n_read[0] < 60
    assert texts(inspection) == []
    points = inspection.topics["/points"]
    assert points.count == 400
    assert points.rate == pytest.approx(10)
    text = inspection_text(inspection, width=1000)
    assert f"read: a sample of {inspection.n_read[0]} of {400 + 400 // every} messages" in text
    assert "`--deep` reads all" in text
    assert "online: has all it needs, as far as the sample shows" in text


@pytest.mark.usefixtures("sampled")
def test_messages_that_come_a_little_early_or_late_are_not_missing(tmp_path):
    for seed in range(10):
        stamps = (TENTHS + np.random.default_rng(seed).uniform(0.0, 0.015, 400)).tolist()
        assert texts(inspect(long_drive(tmp_path / f"{seed}.bag", stamps=stamps))) == []


@pytest.mark.usefixtures("sampled")
def test_deep_reads_all_and_shows_how_far_it_is(tmp_path):
    shown = []
    bag = long_drive(tmp_path / "a.bag")
    inspection = inspect(bag, deep=True, show=lambda *args: shown.append(args[1:]))
    assert inspection.n_read == (800, 400)
    assert texts(inspection) == []
    assert shown == [(done, 800) for done in range(100, 900, 100)] + [(800, 800)]
    assert "read: all 800 messages" in inspection_text(inspection)


@pytest.mark.usefixtures("sampled")
@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"speed": 0.0}, "the reference stands still"),
        ({"offset": 100.0}, "set `clock_offset`"),
        ({"cloud": lambda when: bad_cloud(when, "NaN")}, "clouds hold fewer than 20"),
        ({"cloud": lambda when: bad_cloud(when, "cut")}, "messages do not decode"),
        ({"cloud": lambda _: cloud(START)}, "stamps do not come after"),
        ({"stamps": TENTHS[:100] + TENTHS[300:]}, "/points: about 200 of 400 messages are missing"),
        ({"stamps": TENTHS[:203] + TENTHS[209:]}, "/points: about 6 of 400 messages are missing"),
    ],
)
def test_a_sample_shows_the_faults_of_the_whole(tmp_path, changes, expected):
    inspection = inspect(long_drive(tmp_path / "a.bag", **changes))
    assert inspection.n_read[0] < 60
    assert any(expected in text for text in texts(inspection)), texts(inspection)


@pytest.mark.usefixtures("sampled")
def test_poses_between_the_parts_of_a_sample_are_no_claim(tmp_path):
    # The parts begin every 10 s.
    poses = [(START + 3 * 10**9 + i * 10**7, 0.1 * i) for i in range(400)]
    messages = [("/points", t, cloud(t)) for t in range(START, START + 40 * 10**9, 10**8)]
    messages += [("/poses", t, pose(t, x)) for t, x in poses]
    inspection = inspect(rec.write_bag(tmp_path / "a.bag", sorted(messages, key=lambda m: m[1])))
    expected = "/poses: its 400 messages are not in the sample; `--deep` reads them"
    assert texts(inspection) == [expected]
    assert inspection.missing["offline"] == ()
    assert "offline: can run, but see" in inspection_text(inspection)


@pytest.mark.usefixtures("sampled")
def test_a_robot_may_turn_back_between_the_parts_of_a_sample(tmp_path):
    messages = []
    for i in range(400):
        t = START + i * 10**8
        messages += [("/points", t, cloud(t)), ("/poses", t, pose(t, 10.0 * np.sin(0.08 * i)))]
    inspection = inspect(rec.write_bag(tmp_path / "a.bag", messages))
    assert inspection.n_read[0] < 200
    assert texts(inspection) == []


@pytest.mark.usefixtures("sampled")
def test_bags_of_every_format_are_sampled(tmp_path):
    for bag in fuzz.bags(tmp_path, scans=60):
        inspection = inspect(bag)
        assert 10 < inspection.n_read[0] < 60, bag
        assert texts(inspection) == [], bag
        points = inspection.topics["/points"]
        assert points.count == 60
        assert points.rate == pytest.approx(10)
        assert inspection.missing["online"] == ()
        assert len(list(open_sequence(*entry(inspection).values()))) == 60


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_a_large_bag_is_inspected_by_its_index(tmp_path, name):
    # The benchmark has ten times as many chunks.
    file = Path(__file__).parents[3] / "benchmarks/inspecting.py"
    written = runpy.run_path(str(file))["write_mcap" if name == "a.mcap" else "write_ros1"]
    written(tmp_path / name, 10_000, 800_000)
    assert (tmp_path / name).stat().st_size > 8e9
    inspection = inspect(tmp_path / name)
    assert inspection.n_messages == 120_000
    assert inspection.n_read[0] < 1000
    assert texts(inspection) == []


@pytest.mark.parametrize(
    ("name", "points", "rings", "brightest", "reference", "alone"),
    [
        ("botanic_garden_scan", 24_859, 16, 158, False, 1),
        ("hilti_2022_scan", 57_456, 32, 255, False, 1),
        ("town", 22_687, None, None, True, 0),
        ("campus", 1_934, None, None, True, 0),
        ("hall", 36_726, None, None, True, 0),
        ("street", 21_658, 32, 0, False, 0),
    ],
)
def test_recorded_data(recorded, name, points, rings, brightest, reference, alone):
    inspection = inspect(recorded / f"{name}.bag")
    scan = inspection.scan
    assert len(scan) == points
    assert (None if scan.rings is None else len(np.unique(scan.rings))) == rings
    light = scan.intensities
    assert (None if light is None else light.max()) == brightest
    assert (inspection.reference is not None) == reference
    assert ["a single cloud" in text for text in texts(inspection)] == alone * [True]
    open_sequence(next(iter(entry(inspection).values())))


@pytest.mark.usefixtures("sampled")
def test_bags_that_do_not_follow_each_other_are_named(tmp_path):
    def bag(name, begin):
        stamps = [START + round((begin + 0.1 * i) * 1e9) for i in range(100)]
        rec.write_bag(tmp_path / name, [("/points", when, cloud(when)) for when in stamps])

    bag("a.bag", 0.0)
    bag("b.bag", 11.0)
    assert not any("follow" in text for text in texts(inspect(tmp_path)))
    bag("c.bag", 3e7)
    inspection = inspect(tmp_path)
    (text,) = texts(inspection)
    assert "do not follow each other" in text
    assert "(347 days) lie between b.bag and c.bag" in text
    assert "bags that follow each other" in inspection.missing["online"]
