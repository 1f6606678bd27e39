import errno
import re
import resource
import shutil
import sqlite3
from contextlib import closing

import drives
import fuzz
import numpy as np
import pytest
import rec
from rosbags.rosbag1 import Reader, ReaderError
from rosbags.rosbag1.reader import decompressors
from rosbags.typesys import get_types_from_msg
from small_bag import START, cloud, pose, texts

from adaptune.errors import AdaptuneError, MachineError
from adaptune.recording import SequenceConfig, SequenceError
from adaptune.recording.bag import BagSource, IndexReader
from adaptune.recording.cache import cap, make_room
from adaptune.recording.clouds import CLOUDS, LIVOX_TYPES
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence


def opened(path, **options):
    bag = [str(p) for p in path] if isinstance(path, list) else str(path)
    return open_sequence(SequenceConfig(**({"bag": bag, "cache": False} | options)))


def one_cloud(store=rec.ROS1, stamp=rec.START, **changes):
    return rec.cloud(rec.velodyne(rec.scans(1)[0]), stamp, store, **changes)


def same(a, b):
    return len(a) == len(b) and all(
        x.stamp == y.stamp
        and np.array_equal(x.points, y.points)
        and np.array_equal(x.times, y.times)
        and np.array_equal(x.rings, y.rings)
        for x, y in zip(a, b, strict=True)
    )


@pytest.mark.parametrize(
    ("name", "compression"),
    [
        ("a.bag", None),
        ("a.bag", "BZ2"),
        ("a.bag", "LZ4"),
        ("a.sqlite3", None),
        ("a.sqlite3", "FILE"),
        ("a.sqlite3", "MESSAGE"),
        ("a.mcap", None),
        ("a.mcap", "STORAGE"),
        ("a.mcap", "FILE"),
    ],
)
def test_every_container_and_compression_gives_the_same(tmp_path, name, compression):
    sequence = opened(rec.drive(tmp_path / name, compression=compression), reference="/poses")
    scans = list(sequence)
    clouds = rec.scans(20)
    assert [scan.stamp for scan in scans] == [rec.START + i * 10**8 for i in range(20)]
    assert sequence.n_messages == 20
    for scan, points in zip(scans, clouds, strict=True):
        assert np.array_equal(scan.points, points)
        assert np.array_equal(scan.times, rec.velodyne(points)["time"])
        assert np.array_equal(scan.rings, np.arange(60) % 16)
    reference = sequence.reference()
    assert reference.stamps[0] == rec.START
    np.testing.assert_allclose(reference.T_world_sensor[:, 0, 3], 0.1 * np.arange(40))


def test_bare_files_and_folders_without_metadata_are_read(tmp_path):
    whole = list(opened(rec.drive(tmp_path / "a.mcap")))
    folder = rec.drive(tmp_path / "b.sqlite3")
    (folder / "metadata.yaml").unlink()
    assert same(list(opened(tmp_path / "a.mcap" / "a.mcap.mcap")), whole)
    assert same(list(opened(folder)), whole)
    assert same(list(opened(next(folder.glob("*.db3")))), whole)


def test_metadata_that_count_in_words_are_refused(tmp_path):
    folder = rec.drive(tmp_path / "a.sqlite3")
    metadata = folder / "metadata.yaml"
    metadata.write_text(re.sub(r"message_count: \d+", "message_count: many", metadata.read_text()))
    with pytest.raises(
        SequenceError, match=r"metadata.yaml counts in no numbers.*ros2 bag reindex"
    ):
        list(opened(folder))


def test_a_message_without_bytes_is_damage(tmp_path):
    folder = rec.drive(tmp_path / "a.sqlite3")
    with closing(sqlite3.connect(next(folder.glob("*.db3")))) as database, database:
        database.execute("CREATE TABLE copied AS SELECT * FROM messages")  # which may have gaps
        database.execute("DROP TABLE messages")
        database.execute("ALTER TABLE copied RENAME TO messages")
        database.execute("UPDATE messages SET data = NULL WHERE id = 5")
    with pytest.raises(SequenceError, match="the bag is damaged"):
        list(opened(folder))


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_bags_that_follow_each_other_are_one(tmp_path, suffix):
    clouds, parts = rec.scans(6), []
    for part in range(3):
        path = tmp_path / f"part_{part}{suffix}"
        store = rec.store_of(path)
        stamps = [rec.START + i * 10**8 for i in (2 * part, 2 * part + 1)]
        messages = [
            ("/points", s, rec.cloud(rec.velodyne(clouds[2 * part + i]), s, store))
            for i, s in enumerate(stamps)
        ]
        parts.append(rec.write_bag(path, messages))
    sequence = opened(parts[::-1])
    assert "2 more" in sequence.name
    scans = list(sequence)
    assert all(np.array_equal(s.points, c) for s, c in zip(scans, clouds, strict=True))
    assert same(list(opened(tmp_path / f"part_*{suffix}")), scans)
    if suffix == ".bag":
        assert same(list(opened(tmp_path)), scans)


def test_a_section_counts_from_the_first_scan(tmp_path):
    bag = rec.drive(tmp_path / "a.bag")
    stamps = [(s.stamp - rec.START) // 10**8 for s in opened(bag, start=0.45, stop=1.5, stride=3)]
    assert stamps == [5, 8, 11, 14]
    with pytest.raises(SequenceError, match=r"no scan between start = 7 s and stop = the end"):
        list(opened(bag, start=7))


def test_topics_are_found_or_asked_for(tmp_path):
    bag = rec.drive(tmp_path / "a.bag")
    for options, message in [
        ({"points": "/pionts"}, r"no topic /pionts; did you mean '/points'\?"),
        ({"points": "/poses"}, "/poses is geometry_msgs/msg/PoseStamped, not point clouds"),
        ({"reference": "/points"}, "not poses"),
        ({"imu": {"topic": "/imu"}}, "no topic /imu"),
    ]:
        with pytest.raises(SequenceError, match=message):
            opened(bag, **options)
    two = rec.write_bag(tmp_path / "two.bag", [(t, rec.START, one_cloud()) for t in ("/a", "/b")])
    with pytest.raises(SequenceError, match="2 topics with point clouds, name one of them: /a, /b"):
        opened(two)
    assert len(list(opened(two, points="/b"))) == 1


def clouds_at(path, stamps, clouds, frames=("lidar",)):
    messages = []
    for i, (stamp, points) in enumerate(zip(stamps, clouds, strict=True)):
        header = rec.header(stamp, frames[i % len(frames)], rec.ROS1)
        raw = rec.velodyne(points)
        messages.append(("/points", stamp, rec.cloud(raw, stamp, rec.ROS1, header=header)))
    return rec.write_bag(path, messages)


@pytest.mark.parametrize(
    ("later", "same", "what"),
    [
        (5 * 10**7, True, "3 of 6 clouds repeat the points of the one before"),
        (1000, True, "3 of 6 clouds repeat the points of the one before"),
        (1000, False, "3 of 6 clouds come less than 1 ms after the one before"),
    ],
)
def test_scans_that_repeat_the_one_before_are_left_out(tmp_path, caplog, later, same, what):
    first, others = rec.scans(3), rec.scans(3, seed=1)
    stamps = [rec.START + i * 10**8 + after for i in range(3) for after in (0, later)]
    clouds = [points for i in range(3) for points in (first[i], (first if same else others)[i])]
    scans = list(opened(clouds_at(tmp_path / "a.bag", stamps, clouds)))
    assert [scan.stamp for scan in scans] == stamps[::2]
    assert what in caplog.text


def test_clouds_of_two_frames_are_one_sensor_s_only_when_it_is_named(tmp_path):
    stamps = [rec.START + i * 10**8 for i in range(6)]
    bag = clouds_at(tmp_path / "a.bag", stamps, rec.scans(6), ("front", "/rear"))
    for options in ({}, {"frame": "raer"}):
        with pytest.raises(SequenceError, match="/points holds clouds of 'front', 'rear'; name"):
            list(opened(bag, **options))
    assert [scan.stamp for scan in opened(bag, frame="rear")] == stamps[1::2]
    nameless = clouds_at(tmp_path / "c.bag", stamps, rec.scans(6), ("", "front"))
    with pytest.raises(SequenceError, match="/points holds clouds of '', 'front'; name"):
        list(opened(nameless))
    slashed = clouds_at(tmp_path / "b.bag", stamps, rec.scans(6), ("front", "/front"))
    assert len(list(opened(slashed))) == 6


@pytest.mark.parametrize("cache", [False, True])
def test_times_that_cannot_be_stop_a_sequence_before_its_first_scan(tmp_path, cache):
    messages = [
        ("/points", stamp, rec.cloud(rec.velodyne(points, span=1.0), stamp, rec.ROS1))
        for stamp, points in zip(range(rec.START, 2 * rec.START, 10**8), rec.scans(8), strict=False)
    ]
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(SequenceError, match=r"a.bag: .*write `time_unit: turn`"):
        next(iter(opened(bag, cache=cache)))
    assert len(list(opened(bag, cache=cache, time_unit="turn"))) == 8
    assert len(list(opened(bag, cache=cache, time_unit="s"))) == 8  # by its user's own word


def poses_of(store):
    """Two poses in a message of each type, at (0, 0, 0) and (1, 2, 3) turned half about z."""
    t = store.types
    q = (0.0, 0.0, 1.0, 0.0)
    stamps = (rec.START, rec.START + 10**9)
    where = (((0, 0, 0), (0, 0, 0, 1)), ((1, 2, 3), q))
    poses = [rec.bare_pose(p, o, store) for p, o in where]
    stamped = [rec.pose(s, p, o, store) for s, (p, o) in zip(stamps, where, strict=True)]
    covariance = np.zeros(36)
    with_covariance = [t["geometry_msgs/msg/PoseWithCovariance"](p, covariance) for p in poses]
    zero = t["geometry_msgs/msg/Vector3"](0, 0, 0)
    twist = t["geometry_msgs/msg/TwistWithCovariance"](
        t["geometry_msgs/msg/Twist"](zero, zero), covariance
    )
    headers = [rec.header(s, "map", store) for s in stamps]
    transforms = [
        t["geometry_msgs/msg/TransformStamped"](
            h,
            "lidar",
            t["geometry_msgs/msg/Transform"](
                t["geometry_msgs/msg/Vector3"](*p), t["geometry_msgs/msg/Quaternion"](*o)
            ),
        )
        for h, (p, o) in zip(headers, where, strict=True)
    ]
    return {
        "PoseStamped": stamped,
        "PoseWithCovarianceStamped": [
            t["geometry_msgs/msg/PoseWithCovarianceStamped"](h, p)
            for h, p in zip(headers, with_covariance, strict=True)
        ],
        "Odometry": [
            t["nav_msgs/msg/Odometry"](h, "lidar", p, twist)
            for h, p in zip(headers, with_covariance, strict=True)
        ],
        "Path": [t["nav_msgs/msg/Path"](headers[1], stamped[:n]) for n in (1, 2)],
        "TransformStamped": transforms,
        "TFMessage": [t["tf2_msgs/msg/TFMessage"]([x]) for x in transforms],
    }


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_poses_come_in_many_types(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    store = rec.store_of(path)
    messages = [("/points", rec.START, one_cloud(store))]
    for kind, poses in poses_of(store).items():
        messages += [(f"/{kind}", rec.START + i, m) for i, m in enumerate(poses)]
    bag = rec.write_bag(path, messages)
    for kind in poses_of(store):
        reference = opened(bag, reference=f"/{kind}").reference()
        assert reference.stamps.tolist() == [rec.START, rec.START + 10**9]
        np.testing.assert_allclose(reference.T_world_sensor[1][:3, 3], [1, 2, 3])
        np.testing.assert_allclose(np.diag(reference.T_world_sensor[1]), [-1, -1, 1, 1], atol=1e-12)


@pytest.mark.parametrize("kind", ["Path", "PoseStamped", "TransformStamped"])
def test_poses_whose_stamps_were_never_set_are_named(tmp_path, kind):
    poses = poses_of(rec.ROS1)[kind]
    for each in poses[-1].poses if kind == "Path" else poses:
        each.header.stamp.sec = each.header.stamp.nanosec = 0
    messages = [(f"/{kind}", rec.START + i, m) for i, m in enumerate(poses)]
    messages += [("/points", rec.START + i * 10**8, one_cloud()) for i in range(3)]
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    what = "all its 2 poses have the stamp 0 s; name another"
    with pytest.raises(SequenceError, match=f"a.bag: /{kind}: {what} `reference`"):
        opened(bag, reference=f"/{kind}").reference()
    found = inspect(bag)
    assert f"/{kind}: {what} topic, or a file of poses" in texts(found)
    assert "poses with stamps" in found.missing["offline"]
    assert not any("clock_offset" in text for text in texts(found))


def test_of_transforms_one_frame_is_taken(tmp_path):
    transforms = [m.transforms[0] for m in poses_of(rec.ROS1)["TFMessage"]]
    transforms[0].child_frame_id = "base"
    messages = [
        ("/points", rec.START, one_cloud()),
        ("/tf", rec.START, rec.ROS1.types["tf2_msgs/msg/TFMessage"](transforms)),
    ]
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(SequenceError, match="`child_frame`, or a chain: base, lidar"):
        opened(bag, reference="/tf").reference()
    with pytest.raises(SequenceError, match="did you mean 'lidar'"):
        opened(bag, reference="/tf", child_frame="lida").reference()
    assert len(opened(bag, reference="/tf", child_frame="base").reference()) == 1


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
def test_frames_that_do_not_move_are_known(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    store = rec.store_of(path)
    (first, second) = (m.transforms[0] for m in poses_of(store)["TFMessage"])
    first.child_frame_id, second.child_frame_id = "lidar", "imu"
    first.header.frame_id = second.header.frame_id = "base"
    static = store.types["tf2_msgs/msg/TFMessage"]([first, second])
    messages = [("/points", rec.START, one_cloud(store)), ("/tf_static", rec.START, static)]
    frame, fixed = opened(rec.write_bag(path, messages)).source.fixed_frames()
    assert frame == "lidar"
    assert fixed == {
        "lidar": ("base", [0, 0, 0, 0, 0, 0, 1]),
        "imu": ("base", [1, 2, 3, 0, 0, 1, 0]),
    }
    bare = rec.write_bag(tmp_path / f"b{suffix}", messages[:1])
    assert opened(bare).source.fixed_frames() == ("lidar", {})


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".sqlite3"])
@pytest.mark.parametrize("kind", LIVOX_TYPES)
@pytest.mark.parametrize("n", [0, 1, 2, 50])
def test_livox_messages_are_read(tmp_path, kind, suffix, n):
    path = tmp_path / f"a{suffix}"
    points = rec.scans(1, n)[0]
    message = rec.livox(rec.store_of(path), kind, points)
    (scan,) = opened(rec.write_bag(path, [("/livox/lidar", rec.START, message)]))
    assert scan.stamp == rec.START
    assert np.array_equal(scan.points, points)
    np.testing.assert_allclose(scan.times, np.arange(n) * 1e-6, atol=1e-9)
    assert np.array_equal(scan.rings, np.arange(n) % 6)


def bag_of_stamps(path, stamps, delay=0.0):
    """One scan each 0.1 s on the recorder's clock, stamped as said, in seconds."""
    clouds = rec.scans(len(stamps))
    messages = [
        (
            "/points",
            rec.START + round((0.1 * i + delay) * 1e9),
            rec.cloud(rec.velodyne(c), rec.START + round(s * 1e9), rec.ROS1),
        )
        for i, (s, c) in enumerate(zip(stamps, clouds, strict=True))
    ]
    return rec.write_bag(path, messages)


@pytest.mark.parametrize(
    ("stamps", "kept", "told"),
    [
        ([0, 0.1, 0.1, 0.3], [0, 0.1, 0.3], "1 scans whose stamps do not come after"),
        ([0, 0.1, 0.05, 0.3], [0, 0.1, 0.3], "1 scans whose stamps do not come after"),
        ([0, 0.1, 900, 0.3, 0.4], [0, 0.1, 0.3, 0.4], "1 scans whose stamps leap ahead"),
        ([900, 0.1, 0.2, 0.3], [0.1, 0.2, 0.3], "1 scans whose stamps leap ahead"),
        ([0, 0.1, 0.2, 900], [0, 0.1, 0.2, 900], None),
        ([0, 0.1, 30.2, 30.3], [0, 0.1, 30.2, 30.3], None),
    ],
)
@pytest.mark.parametrize("cache", [False, True])
def test_wrong_stamps_cost_the_fewest_scans_and_are_told(
    tmp_path, caplog, *, stamps, kept, told, cache
):
    bag = bag_of_stamps(tmp_path / "a.bag", stamps, delay=0.02)
    for _ in range(2):
        caplog.clear()
        scans = list(opened(bag, cache=cache))
        assert [round((s.stamp - rec.START) * 1e-9, 3) for s in scans] == kept
        assert (told in caplog.text) if told else not caplog.records


def test_unusable_poses_are_left_out_and_told(tmp_path, caplog):
    nan = float("nan")
    given = [
        (0, (0, 0, 0), (0, 0, 0, 1)),
        (1, (nan, 0, 0), (0, 0, 0, 1)),
        (2, (2, 0, 0), (0, 0, 0, 0)),
        (3, (3, 0, 0), (0, 0, 0, 1)),
        (3, (99, 0, 0), (0, 0, 0, 1)),
        (4, (900, 0, 0), (0, 0, 0, 2)),
    ]
    messages = [
        ("/poses", i, rec.pose(rec.START + s * 10**9, p, q, rec.ROS1))
        for i, (s, p, q) in enumerate(given)
    ]
    messages.append(("/points", 0, one_cloud()))
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    reference = opened(bag, reference="/poses").reference()
    assert reference.T_world_sensor[:, 0, 3].tolist() == [0, 3]
    assert "/poses: 2 of 6 poses are not finite or have no rotation" in caplog.text
    assert "the reference jumps by up to 897 m" in caplog.text


@pytest.mark.parametrize("frames", [("map", "odom"), ("map", "map", "odom"), ("odom", "", "odom")])
def test_of_two_nodes_on_a_topic_one_counts(tmp_path, caplog, frames):
    messages = [("/points", 0, one_cloud())]
    for i in range(30):
        made = rec.pose(rec.START + i * 10**8, (0.1 * i, 0, 0), (0, 0, 0, 1), rec.ROS1)
        made.header.frame_id = frames[i % len(frames)]
        messages.append(("/poses", i, made))
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    most = max(frames, key=frames.count)
    number = 30 * frames.count(most) // len(frames)
    assert len(opened(bag, reference="/poses").reference()) == number
    assert f"{30 - number} of 30 poses are of the frame" in caplog.text
    assert f"not {most!r}" in caplog.text
    assert "poses are of the frame" in " ".join(map(str, inspect(bag).findings))


def truncated(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])
    return path


def without_index(path):
    """As a ROS 1 recorder that was killed leaves a bag: index_pos is zero."""
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    return path


def scrambled(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 3 : len(data) // 3 + 400] = b"\xa5" * 400
    path.write_bytes(data)
    return path


def file_of(folder):
    return next(p for p in folder.iterdir() if p.suffix in (".db3", ".mcap"))


BROKEN = {
    "no such file": lambda tmp: tmp / "none.bag",
    "a text": lambda tmp: _text(tmp / "a.bag"),
    "empty file": lambda tmp: _text(tmp / "a.bag", ""),
    "cut short": lambda tmp: truncated(rec.drive(tmp / "a.bag"), 0.6),
    "cut short, LZ4": lambda tmp: truncated(rec.drive(tmp / "a.bag", compression="LZ4"), 0.5),
    "mcap cut short": lambda tmp: truncated(file_of(rec.drive(tmp / "a.mcap")), 0.6),
    "sqlite cut short": lambda tmp: truncated(file_of(rec.drive(tmp / "a.sqlite3")), 0.5),
    "no index": lambda tmp: without_index(rec.drive(tmp / "a.bag")),
    "scrambled": lambda tmp: scrambled(rec.drive(tmp / "a.bag", compression="BZ2")),
    "no message": lambda tmp: rec.write_bag(
        tmp / "a.bag", [], topics=[("/points", "sensor_msgs/msg/PointCloud2")]
    ),
    "no topic": lambda tmp: rec.write_bag(tmp / "a.bag", []),
    "ROS 1 and 2": lambda tmp: [rec.drive(tmp / "a.bag"), rec.drive(tmp / "a.mcap")],
}


def _text(path, text="not a bag at all\n"):
    path.write_text(text)
    return path


@pytest.mark.parametrize("make", BROKEN.values(), ids=BROKEN)
@pytest.mark.parametrize("cache", [False, True])
def test_a_broken_bag_is_a_clear_error(tmp_path, make, cache, cache_folder):
    path = make(tmp_path)
    with pytest.raises(AdaptuneError) as caught:
        list(opened(path, cache=cache))
    message = str(caught.value)
    assert str(path[0] if isinstance(path, list) else path) in message
    assert "\n" not in message
    assert not list(cache_folder.glob("*")), "half a cache was left"


def test_a_damaged_message_is_named(tmp_path):
    bad = one_cloud(stamp=rec.START + 10**8, data=np.empty(9, np.uint8))
    messages = [("/p", rec.START, one_cloud()), ("/p", rec.START + 1, bad)]
    bag = rec.write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(SequenceError, match=r"a\.bag: message 2 on /p: 1 x 60 points of 22 bytes"):
        list(opened(bag))


def test_an_unknown_custom_type_beside_the_clouds_does_no_harm(tmp_path):
    rec.ROS1.register(get_types_from_msg("float32 a\nuint8[] b\n", "my_msgs/msg/Odd"))
    odd = rec.ROS1.types["my_msgs/msg/Odd"](1.0, np.zeros(4, np.uint8))
    bag = rec.write_bag(tmp_path / "a.bag", [("/odd", 5, odd), ("/points", rec.START, one_cloud())])
    assert len(list(opened(bag))) == 1
    with pytest.raises(SequenceError, match="/odd is my_msgs/msg/Odd, not point clouds"):
        opened(bag, points="/odd")


def many(path, compression=None):
    """Several chunks; poses in only some of them."""
    messages = []
    for i in range(30):
        t = START + i * 10**8
        messages.append(("/0", t, cloud(t)))
        if 7 < i < 12:
            messages.append(("/1", t, pose(t, 0.1 * i)))
    return rec.write_bag(path, messages, compression, chunk=10_000)


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_is_what_rosbags_reads(tmp_path, compression):
    path = many(tmp_path / "a.bag", compression)
    with Reader(path) as theirs, IndexReader(path) as ours:
        assert len(ours.chunk_infos) > 3
        assert len({len(info.connection_counts) for info in ours.chunk_infos}) == 2
        assert ours.chunk_infos == theirs.chunk_infos
        counts = [[(c.topic, c.msgcount) for c in r.connections] for r in (ours, theirs)]
        assert counts[0] == counts[1]
        assert (ours.start_time, ours.end_time) == (theirs.start_time, theirs.end_time)
        assert ours.is_slow() == (compression == "BZ2")
        for start, stop in [(None, None), (START + 10**9, START + 2 * 10**9), (START, START)]:
            read = [[m[1:] for m in r.messages(start=start, stop=stop)] for r in (ours, theirs)]
            assert read[0] == read[1]
        for connection in theirs.connections:
            own = [c for c in ours.connections if c.id == connection.id]
            assert len(list(ours.messages(own))) == connection.msgcount


def test_what_bz2_packs_is_unpacked_once(tmp_path, monkeypatch):
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))
    path, packed, unpack = many(tmp_path / "a.bag", "BZ2"), [], decompressors["bz2"]

    def counted(data):
        packed.append(data)
        return unpack(data)

    monkeypatch.setitem(decompressors, "bz2", counted)
    first = list(opened(path, cache=True))
    n = len(packed)
    assert len(packed) == len({*packed}) > 3
    other = opened(path, cache=True, stop=1.0, reference="/1")  # is decoded anew
    assert same(list(other), first[:10])
    assert other.reference() is not None
    assert len(packed) == n
    # What is unpacked is removed as other entries are.
    (entry,) = {file.parent for file in (tmp_path / "cache").glob("*/*") if file.stem.isdigit()}
    shutil.rmtree(entry)
    list(opened(path, cache=True, stop=2.0))  # reads no chunk after that
    assert n < (again := len(packed)) < 2 * n
    make_room(cap())
    assert not entry.exists()
    # A bag that may not fit is not kept, nor what a study wants to have no cache.
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", str(2e-9 * path.stat().st_size))
    list(opened(path, cache=True))
    assert not entry.exists()
    monkeypatch.delenv("ADAPTUNE_CACHE_GB")
    list(opened(path))
    assert not entry.exists()
    assert len(packed) >= again + 2 * n


def test_only_chunks_of_the_time_are_looked_up(tmp_path):
    path = many(tmp_path / "a.bag")
    with IndexReader(path) as reader:
        first = reader.chunk_infos[0]
        last = reader.chunk_infos[-1]
    with path.open("r+b") as file:
        file.seek(last.pos)
        file.write(b"\xff" * 64)
    with pytest.raises(ReaderError):
        Reader(path).open()
    with IndexReader(path) as reader:
        assert list(reader.messages(stop=first.end_time))
        with pytest.raises(ReaderError):
            list(reader.messages(start=last.start_time))


def test_damaged_messages_give_scans_or_an_error():
    counts = fuzz.counted(fuzz.of_messages(), 1, range(600))
    assert min(counts["read"], counts["errors"]) > 100


def test_damaged_bags_give_scans_or_an_error(tmp_path):
    counts = fuzz.counted(fuzz.of_bags(tmp_path), 3, range(50))
    assert min(counts["read"], counts["errors"]) > 5


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.sqlite3"])
def test_a_topic_of_two_types_is_read_by_both_decoders(tmp_path, name):
    path, (kind, _) = tmp_path / name, LIVOX_TYPES
    store = rec.store_of(path)
    clouds = rec.scans(4)
    with rec.writer_of(path) as writer:
        ids = [
            writer.add_connection("/points", of, typestore=store)
            for of in ("sensor_msgs/msg/PointCloud2", kind)
        ]
        for i, points in enumerate(clouds):
            stamp, livox = rec.START + i * 10**8, i % 4 > 1
            made = rec.livox(store, kind, points, stamp) if livox else None
            made = made or rec.cloud(rec.velodyne(points), stamp, store)
            made.header.frame_id = "lidar"
            of = made.__msgtype__
            write = store.serialize_ros1 if store is rec.ROS1 else store.serialize_cdr
            writer.write(ids[livox], stamp, write(made, of))
    scans = list(opened(path))
    assert [len(scan) for scan in scans] == [60] * 4
    np.testing.assert_array_equal(scans[3].points, clouds[3])
    (said,) = [text for text in map(str, inspect(path).findings) if "types" in text]
    assert said == (
        f"/points: messages of 2 types (2 sensor_msgs/msg/PointCloud2, 2 {kind}); adaptune reads "
        "each as what it is"
    )


@pytest.mark.parametrize("journal", ["-wal", "-journal"])
def test_a_journal_that_a_recorder_left_is_named(tmp_path, journal):
    folder = rec.drive(tmp_path / "a.sqlite3")
    (database,) = folder.glob("*.db3")
    left = database.with_name(database.name + journal)
    left.write_bytes(b"")
    assert len(list(opened(folder))) == 20
    left.write_bytes(b"messages")
    for path in (folder, database):
        with pytest.raises(SequenceError, match=rf"db3{journal}: holds messages .*pragma wal_ch"):
            list(opened(path))


@pytest.mark.parametrize("suffix", [".bag", ".sqlite3", ".mcap"])
def test_more_parts_than_a_process_may_open_are_no_damage(tmp_path, suffix):
    n = 60
    parts = [rec.drive(tmp_path / f"part{i:02}{suffix}", 2) for i in range(n)]
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (n, before[1]))
    try:
        with pytest.raises(MachineError, match="too many open files; raise `ulimit -n`"):
            opened(parts)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_machine_without_room_is_not_taken_for_a_damaged_scan(tmp_path, monkeypatch):
    path = rec.drive(tmp_path / "a.bag", 2)

    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setitem(CLOUDS, "sensor_msgs/msg/PointCloud2", full)
    with pytest.raises(MachineError, match="the disk is full"):
        list(opened(path))
    with pytest.raises(MachineError, match="the disk is full"):
        inspect(path)


def test_poses_are_read_once_until_the_file_changes(tmp_path, monkeypatch):
    reads, read = [], BagSource.messages

    def counted(source, topic, **given):
        reads.append(topic)
        return read(source, topic, **given)

    monkeypatch.setattr(BagSource, "messages", counted)
    path = tmp_path / "one.bag"
    config = SequenceConfig(bag=str(path), points="/points", reference="/truth")
    for n in (40, 50):
        path.unlink(missing_ok=True)
        drives.write_bag(path, drives.scans(n_scans=n))
        references = [open_sequence(config).reference() for _ in range(3)]
        assert [len(reference) for reference in references] == [n] * 3
    assert reads.count("/truth") == 2


def test_the_same_bags_are_opened_once(tmp_path, monkeypatch):
    looked, look = [], BagSource.look_at_clock
    monkeypatch.setattr(
        BagSource, "look_at_clock", lambda *given: looked.append(given[0].name) or look(*given)
    )
    path = tmp_path / "one.bag"
    config = SequenceConfig(bag=str(path), points="/points", reference="/truth")
    for n in (40, 50):
        path.unlink(missing_ok=True)
        drives.write_bag(path, drives.scans(n_scans=n))
        assert [open_sequence(config).n_messages for _ in range(3)] == [n] * 3
    assert looked == [str(path)] * 2
