from pathlib import Path

import numpy as np
import pytest
import rec

from adaptune.errors import AdaptuneError
from adaptune.evaluation.given import Convention, by_name, parted, read
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import RecordedSequence
from adaptune.trajectory import Trajectory, write_tum

N = 20


def stamped(kind, at, frame="map"):
    """A message of a pose at x metres, `at` a tenth of a second."""
    types, stamp = rec.ROS1.types, rec.START + at * 10**8
    pose = rec.bare_pose((0.1 * at, 0, 0), (0, 0, 0, 1), rec.ROS1)
    header = rec.header(stamp, frame, rec.ROS1)
    if kind == "pose":
        return types["geometry_msgs/msg/PoseStamped"](header, pose)
    if kind == "path":
        every = [stamped("pose", i, frame) for i in range(at + 1)]
        return types["nav_msgs/msg/Path"](header, every)
    covariance = np.zeros(36)
    with_covariance = types["geometry_msgs/msg/PoseWithCovariance"](pose, covariance)
    zero = types["geometry_msgs/msg/Vector3"](0, 0, 0)
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        types["geometry_msgs/msg/Twist"](zero, zero), covariance
    )
    return types["nav_msgs/msg/Odometry"](header, "lidar", with_covariance, twist)


def transform(parent, child, at, x):
    types = rec.ROS1.types
    motion = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](x, 0, 0),
        types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
    )
    header = rec.header(rec.START + at * 10**8, parent, rec.ROS1)
    made = types["geometry_msgs/msg/TransformStamped"](header, child, motion)
    return types["tf2_msgs/msg/TFMessage"]([made])


def messages_of(topic, made):
    return [(topic, rec.START + i * 10**8, message) for i, message in enumerate(made)]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Scans, poses of all kinds, and two nodes on a topic."""
    scans = [
        rec.cloud(rec.velodyne(points), rec.START + i * 10**8, rec.ROS1)
        for i, points in enumerate(rec.scans(N))
    ]
    messages = messages_of("/points", scans)
    for topic in ("odom", "pose", "path"):
        messages += messages_of(f"/{topic}", [stamped(topic, i) for i in range(N)])
    both = [stamped("odom", i, ("map", "odom")[i % 2]) for i in range(N)]
    messages += messages_of("/both", both)
    # The map moves rarely, and the base often; the LiDAR is fixed on the base.
    messages += messages_of("/tf", [transform("odom", "base", i, 0.1 * i) for i in range(N)])
    messages += messages_of("/tf", [transform("map", "odom", i, 1.0) for i in (0, N - 1)])
    by_turns = [transform(("map", "odom")[i % 2], "other", i, 0.0) for i in range(N)]
    messages += messages_of("/tf", by_turns)
    messages += messages_of("/tf_static", [rec.fixed_frame("lidar", "base", (0.0, 0.5, 0.0))])
    messages.sort(key=lambda message: message[1])
    return rec.write_bag(tmp_path_factory.mktemp("bags") / "a.bag", messages)


@pytest.fixture
def scans(bag):
    return RecordedSequence(SequenceConfig(bag=str(bag), points="/points", reference="none"))


def positions(given, scans):
    return read(str(given), given, scans, Convention(), 10**8).T_world_sensor[:, :3, 3]


@pytest.mark.parametrize("topic", ["/odom", "/pose", "/path", "BAG:/odom", "BAG:/path"])
def test_poses_of_all_kinds_are_read_from_this_bag_and_others(bag, scans, topic):
    found = positions(topic.replace("BAG", str(bag)), scans)
    np.testing.assert_allclose(found[:, 0], 0.1 * np.arange(N), atol=1e-9)


def test_a_chain_of_transforms_is_followed(bag, scans):
    for given in ("/tf:map.lidar", f"{bag}:/tf:map.lidar"):
        found = positions(given, scans)
        np.testing.assert_allclose(found[:, 0], 1.0 + 0.1 * np.arange(N), atol=1e-9)
        np.testing.assert_allclose(found[:, 1], 0.5, atol=1e-9)
    np.testing.assert_allclose(positions("/tf:odom.base", scans)[:, 1], 0.0)
    known = "no chain leads from map to base_link; there is base, lidar, map, odom, other"
    with pytest.raises(AdaptuneError, match=known):
        positions("/tf:map.base_link", scans)
    with pytest.raises(AdaptuneError, match="or a chain: base, odom, other"):
        positions("/tf", scans)
    with pytest.raises(AdaptuneError, match="other has two parents, map and odom: two nodes"):
        positions("/tf:map.other", scans)


def test_poses_of_two_nodes_are_refused(scans):
    with pytest.raises(AdaptuneError, match="has poses of 'map' and 'odom': two nodes publish"):
        positions("/both", scans)


def test_arrays_and_files(scans, tmp_path):
    stamps, T = rec.START + np.arange(N) * 10**8, np.tile(np.eye(4), (N, 1, 1))
    T[:, 0, 3] = np.arange(N)
    made = Trajectory(stamps, T)
    write_tum(tmp_path / "a.tum", made)
    rows = T[:, :3].reshape(N, 12)
    np.savetxt(tmp_path / "kitti.txt", rows)
    for given in (
        made,
        (stamps, T),
        (stamps * 1e-9, T),
        tmp_path / "a.tum",
        tmp_path / "kitti.txt",
    ):
        np.testing.assert_allclose(positions(given, scans)[:, 0], np.arange(N))
    np.savetxt(tmp_path / "few.txt", rows[:-1])
    with pytest.raises(AdaptuneError, match="19 poses without stamps do not go with 20 scans"):
        positions(tmp_path / "few.txt", scans)


def test_conventions_are_applied(scans):
    place = np.eye(4)
    place[1, 3] = 2.0
    by = Convention(place, 0.5, "end")
    found = read("/odom", "/odom", scans, by, 10**8)
    np.testing.assert_allclose(found.T_world_sensor[:, 1, 3], 2.0)
    assert found.stamps[0] == rec.START + 6 * 10**8
    with pytest.raises(AdaptuneError, match=r"no times, .*; give --clock-offset instead of --pose"):
        read("/odom", "/odom", scans, by, 0)


def test_the_option_that_mends_another_clock_is_named_with_all_that_is_to_be_added(scans):
    by = Convention(clock_offset=1000.0)
    stamps, T = rec.START + np.arange(N) * 10**8, np.tile(np.eye(4), (N, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(N)
    with pytest.raises(
        AdaptuneError, match=r"my\.tum covers .*: set `--clock-offset` to the seconds"
    ):
        read("my.tum", Trajectory(stamps, T), scans, by, 10**8)


def test_bags_are_told_from_trajectories(tmp_path):
    (tmp_path / "drives").mkdir()
    folder, file = str(tmp_path / "drives"), str(tmp_path / "a.tum")
    words = ["a.bag", "b.mcap", folder, "/odom", "run2.bag:/odom", file]
    bags, others = parted(words)
    assert [str(bag) for bag in bags] == words[:3]
    assert others == words[3:]
    assert parted([file, "a.bag"]) == ([Path("a.bag")], [file])
    assert parted(["none", file]) == ([Path("none")], [file])


def test_files_are_called_by_their_names_where_these_differ(tmp_path):
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.tum").touch()
    (tmp_path / "b.tum").touch()
    one, two = (str(tmp_path / folder / "a.tum") for folder in ("one", "two"))
    given = [one, two, tmp_path / "b.tum", "/odom", (1, 2)]
    assert list(by_name(given)) == [one, two, "b.tum", "/odom", "trajectory 5"]
