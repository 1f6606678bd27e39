import runpy
import struct
import time
from pathlib import Path
from types import SimpleNamespace

import fuzz
import numpy as np
import pytest
from inspected import entry, inspection_text, texts
from small_bag import START, bad_cloud, cloud, pose, write

from adaptune.recording import survey
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence


@pytest.fixture
def sampled(monkeypatch):
    """Every recording is too long to be read completely."""
    monkeypatch.setattr(survey, "SECONDS", 0.0)


def long_drive(path, every=1, **changes):
    """40 s at 10 Hz, 2 m/s; `every` n-th scan has a pose."""
    options = SimpleNamespace(stamps=[0.1 * i for i in range(400)], speed=2.0, offset=0.0)
    vars(options).update(changes)
    messages = []
    for s in options.stamps:
        when = START + round(s * 1e9)
        messages.append(
            ("/points", when, options.cloud(when) if changes.get("cloud") else cloud(when))
        )
        if round(10 * s) % every == 0:
            moved = pose(when + round(options.offset * 1e9), options.speed * s)
            messages.append(("/poses", when, moved))
    return write(path, messages)


@pytest.mark.usefixtures("sampled")
@pytest.mark.parametrize("every", [1, 10, 100])
def test_a_sound_bag_is_sound_in_a_sample(tmp_path, every):
    inspection = inspect(long_drive(tmp_path / "a.bag", every))
    assert inspection.n_read[0] < 60
    assert texts(inspection) == []
    points = next(topic for topic in inspection.topics if topic.name == "/points")
    assert points.count == 400
    assert points.rate == pytest.approx(10)
    text = inspection_text(inspection, width=1000)
    assert f"read: a sample of {inspection.n_read[0]} of {400 + 400 // every} messages" in text
    assert "`--deep` reads all" in text
    assert "online: has all it needs, as far as the sample shows" in text


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
        ({"cloud": lambda _: cloud(START)}, "stamps are the same"),
        (
            {"stamps": [0.1 * i for i in (*range(100), *range(300, 400))]},
            "/points: about 200 of 400 messages are missing",
        ),
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
    inspection = inspect(write(tmp_path / "a.bag", sorted(messages, key=lambda m: m[1])))
    expected = "/poses: its 400 messages are not in the sample, `--deep` reads them"
    assert texts(inspection) == [expected]
    assert inspection.missing["offline"] == ()
    assert "offline: can run, but see" in inspection_text(inspection)


@pytest.mark.usefixtures("sampled")
def test_bags_of_every_format_are_sampled(tmp_path):
    for bag in fuzz.bags(tmp_path, scans=60):
        inspection = inspect(bag)
        assert 10 < inspection.n_read[0] < 60, bag
        assert texts(inspection) == [], bag
        points = next(topic for topic in inspection.topics if topic.name == "/points")
        assert points.count == 60
        assert points.rate == pytest.approx(10)
        assert inspection.missing["online"] == ()
        assert len(list(open_sequence(*entry(inspection).values()))) == 60


def without_chunks(path, clouds):
    """An mcap file as `ros2 bag record --storage-preset-profile fastwrite` leaves it."""
    made, rng = fuzz.stores()[True], np.random.default_rng(0)
    definition, _ = made.typestore.generate_msgdef(fuzz.CLOUD, ros_version=2)

    def text(given):
        return struct.pack("<I", len(given)) + given.encode()

    def record(op, *parts):
        body = b"".join(parts)
        return struct.pack("<BQ", op, len(body)) + body

    schema = (struct.pack("<H", 1), text(fuzz.CLOUD), text("ros2msg"), text(definition))
    channel = (struct.pack("<HH", 1, 1), text("/points"), text("cdr"), bytes(4))
    parts = [record(1, text("ros2"), text("")), record(3, *schema), record(4, *channel)]
    for i in range(clouds):
        t = START + i * 10**8
        data = made.typestore.serialize_cdr(fuzz.message(made, "plain", t, rng), fuzz.CLOUD)
        parts.append(record(5, struct.pack("<HIQQ", 1, i, t, t), bytes(data)))
    magic = b"\x89MCAP0\r\n"
    path.write_bytes(magic + b"".join(parts) + record(2, bytes(20)) + magic)
    return path


@pytest.mark.usefixtures("sampled")
def test_the_sample_of_an_mcap_file_without_chunks_is_its_beginning(tmp_path):
    bag = without_chunks(tmp_path / "a.mcap", 200)
    inspection = inspect(bag)
    assert inspection.n_read == (13, 13)
    (topic,) = inspection.topics
    assert topic.count == 200
    assert (topic.first, topic.last) == (START, START + 12 * 10**8)
    assert texts(inspection) == []
    assert inspect(bag, deep=True).n_read == (200, 200)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_a_large_bag_is_inspected_by_its_index(tmp_path, name):
    # The benchmark has ten times as many chunks.
    file = Path(__file__).parents[3] / "benchmarks/inspecting.py"
    written = runpy.run_path(str(file))["write_mcap" if name == "a.mcap" else "write_ros1"]
    written(tmp_path / name, 10_000, 800_000)
    assert (tmp_path / name).stat().st_size > 8e9
    begin = time.process_time()
    inspection = inspect(tmp_path / name)
    assert time.process_time() - begin < 3.0
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
    assert len(inspection.scan.scan) == points
    assert inspection.scan.rings == rings
    light = inspection.scan.scan.intensities
    assert (None if light is None else light.max()) == brightest
    assert (inspection.reference is not None) == reference
    assert ["a single cloud" in text for text in texts(inspection)] == alone * [True]
    open_sequence(next(iter(entry(inspection).values())))


@pytest.mark.usefixtures("sampled")
def test_bags_that_do_not_follow_each_other_are_named(tmp_path):
    def bag(name, begin):
        stamps = [START + round((begin + 0.1 * i) * 1e9) for i in range(100)]
        write(tmp_path / name, [("/points", when, cloud(when)) for when in stamps])

    bag("a.bag", 0.0)
    bag("b.bag", 11.0)
    assert not any("follow" in text for text in texts(inspect(tmp_path)))
    bag("c.bag", 3e7)
    inspection = inspect(tmp_path)
    (text,) = texts(inspection)
    assert "do not follow each other" in text
    assert "(347 days) lie between b.bag and c.bag" in text
    assert "bags that follow each other" in inspection.missing["online"]
