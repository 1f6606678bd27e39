import pytest
from rosbags.rosbag1 import Reader, ReaderError, Writer
from small_bag import START, STORE, cloud, pose

from adaptune.recording.bag import IndexReader


def many(path, compression=None):
    """Several chunks; poses in only some of them."""
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    writer.chunk_threshold = 10_000
    with writer:
        kinds = ("sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseStamped")
        clouds, poses = (
            writer.add_connection(f"/{i}", kind, typestore=STORE) for i, kind in enumerate(kinds)
        )
        for i in range(30):
            t = START + i * 10**8
            writer.write(clouds, t, STORE.serialize_ros1(cloud(t), kinds[0]))
            if 7 < i < 12:
                writer.write(poses, t, STORE.serialize_ros1(pose(t, 0.1 * i), kinds[1]))
    return path


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
