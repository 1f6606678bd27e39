"""How long `adaptune inspect` takes on large recordings.

    python benchmarks/inspecting.py [--chunks 100000] [--gigabytes 80] [--folder SCRATCH]

The script writes sparse bags of ROS 1 and of ROS 2 (mcap) to a scratch folder. Their index is
whole, and every chunk holds a cloud, a pose and ten messages of an IMU. Most of the clouds' points
are holes in the file, so the bags take 4 to 8 kB of disk for each chunk. Each file is inspected
twice; the second time counts.
"""

import argparse
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

START, PERIOD = 1_700_000_000 * 10**9, 10**8
VALID, STEP = 30, 16  # points that are no hole, and bytes of a point
TYPES = {
    "/points": "sensor_msgs/msg/PointCloud2",
    "/gt_poses": "geometry_msgs/msg/PoseStamped",
    "/imu": "sensor_msgs/msg/Imu",
}
STORES = {1: get_typestore(Stores.ROS1_NOETIC), 2: get_typestore(Stores.ROS2_HUMBLE)}


class Recorded(NamedTuple):
    """A message as it is written."""

    topic: int
    when: int
    data: bytes
    hole: int  # bytes at its end that are a hole in the file


def messages(ros: int, points: int) -> list[tuple[bytes, int]]:
    """A serialised message of each topic, and how many bytes at its end to leave out."""
    store = STORES[ros]
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](0, 0)
    header = types["std_msgs/msg/Header"](*((0,) if ros == 1 else ()), stamp, "lidar")
    field = types["sensor_msgs/msg/PointField"]
    fields = [field(name, 4 * i, 7, 1) for i, name in enumerate(("x", "y", "z", "time"))]
    data = np.random.default_rng(0).normal(0, 10, (VALID, 4)).astype("<f4")
    data[:, 3] = np.linspace(0, 0.1, VALID)
    raw = np.zeros(points * STEP, np.uint8)
    raw[: data.nbytes] = data.view(np.uint8).ravel()
    vector = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 9.81)
    q = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    place = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](0.0, 0.0, 0.0), q)
    none = np.zeros(9)
    cloud = (header, 1, points, fields, False, STEP, STEP * points, raw, True)
    measured = (header, q, none, vector, none, vector, none)
    parts = (cloud, (header, place), measured)
    serialize: Any = store.serialize_ros1 if ros == 1 else store.serialize_cdr
    made = [
        bytes(serialize(types[kind](*given), kind))
        for kind, given in zip(TYPES.values(), parts, strict=True)
    ]
    hole = raw.nbytes - data.nbytes + 1
    return [(made[0][:-hole], hole), (made[1], 0), (made[2], 0)]


def recorded(made: list[tuple[bytes, int]], number: int) -> list[Recorded]:
    """The messages of a chunk, the cloud last; each pose is 0.1 m beyond the one before."""
    found = []
    for topic, after in ((1, 0), *((2, i * PERIOD // 10) for i in range(10)), (0, PERIOD - 1)):
        data, hole = bytearray(made[topic][0]), made[topic][1]
        when = START + number * PERIOD + after
        data[4:12] = time1(when)
        if topic == 1:
            data[-56:-48] = struct.pack("<d", 0.1 * number)
        elif topic == 0:  # no two clouds are the same
            begin = len(data) - VALID * STEP
            data[begin : begin + 4] = struct.pack("<f", 0.01 * (number % 1000))
        found.append(Recorded(topic, when, bytes(data), hole))
    return found


def fields1(**values: bytes) -> bytes:
    """Header of a record of ROS 1."""
    parts = [name.encode() + b"=" + value for name, value in values.items()]
    text = b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return struct.pack("<I", len(text)) + text


def u32(number: int) -> bytes:
    """A number of four bytes."""
    return struct.pack("<I", number)


def u64(number: int) -> bytes:
    """A number of eight bytes."""
    return struct.pack("<Q", number)


def time1(stamp: int) -> bytes:
    """A time of ROS 1."""
    return struct.pack("<II", *divmod(stamp, 10**9))


def write_ros1(path: Path, chunks: int, size: int) -> None:
    """Write a bag of so many chunks of `size` bytes."""
    made = messages(1, size // STEP)
    infos = bytearray()
    with path.open("wb") as file:
        file.write(b"#ROSBAG V2.0\n" + b" " * 4096)
        for number in range(chunks):
            infos += _chunk1(file, recorded(made, number))
        index_pos = file.tell()
        for i, (topic, kind) in enumerate(TYPES.items()):
            definition, digest = STORES[1].generate_msgdef(kind)
            given = {
                "topic": topic.encode(),
                "type": kind.replace("/msg/", "/").encode(),
                "md5sum": digest.encode(),
                "message_definition": definition.encode(),
            }
            file.write(fields1(op=b"\7", conn=u32(i), topic=topic.encode()) + fields1(**given))
        file.write(infos)
        file.seek(13)
        counts = {"conn_count": u32(len(TYPES)), "chunk_count": u32(chunks)}
        head = fields1(op=b"\3", index_pos=u64(index_pos), **counts)
        file.write(head + u32(4096 - len(head) - 4))


def _chunk1(file: BinaryIO, given: list[Recorded]) -> bytes:
    """Write a chunk and its index, and give the record of what it holds."""
    chunk, offsets = bytearray(), dict[int, bytes]()
    for topic, when, data, hole in given:
        offsets[topic] = offsets.get(topic, b"") + time1(when) + u32(len(chunk))
        chunk += fields1(op=b"\2", conn=u32(topic), time=time1(when)) + u32(len(data) + hole) + data
    at, hole = file.tell(), given[-1].hole
    head = fields1(op=b"\5", compression=b"none", size=u32(len(chunk) + hole))
    file.write(head + u32(len(chunk) + hole) + chunk)
    file.seek(hole, 1)
    for topic, entries in offsets.items():
        head = fields1(op=b"\4", ver=u32(1), conn=u32(topic), count=u32(len(entries) // 12))
        file.write(head + u32(len(entries)) + entries)
    counts = b"".join(u32(topic) + u32(len(e) // 12) for topic, e in offsets.items())
    span = {"start_time": time1(given[0].when), "end_time": time1(given[-1].when)}
    head = fields1(op=b"\6", ver=u32(1), chunk_pos=u64(at), **span, count=u32(len(offsets)))
    return head + u32(len(counts)) + counts


def record2(op: int, *parts: bytes) -> bytes:
    """A record of mcap."""
    body = b"".join(parts)
    return bytes([op]) + u64(len(body)) + body


def text2(text: str | bytes) -> bytes:
    """A text of mcap."""
    return u32(len(text)) + (text.encode() if isinstance(text, str) else text)


def write_mcap(path: Path, chunks: int, size: int) -> None:
    """Write a bag of so many chunks of `size` bytes, whose indices of messages are holes."""
    made = messages(2, size // STEP)
    magic, infos, counts = b"\x89MCAP0\r\n", bytearray(), dict[int, int]()
    with path.open("wb") as file:
        file.write(magic + record2(1, text2("ros2"), text2("")))
        for number in range(chunks):
            given = recorded(made, number)
            for topic, *_ in given:
                counts[topic] = counts.get(topic, 0) + 1
            infos += _chunk2(file, given)
        summary = file.tell()
        for i, (topic, kind) in enumerate(TYPES.items()):
            definition, _ = STORES[2].generate_msgdef(kind, ros_version=2)
            number2 = struct.pack("<H", i + 1)
            file.write(record2(3, number2, text2(kind), text2("ros2msg"), text2(definition)))
            channel = struct.pack("<HH", i, i + 1)
            file.write(record2(4, channel, text2(topic), text2("cdr"), u32(0)))
        file.write(infos)
        total, many = sum(counts.values()), (len(TYPES), len(TYPES), 0, 0, chunks)
        numbers = struct.pack("<QHIIIIQQ", total, *many, START, START + chunks * PERIOD)
        by_topic = b"".join(struct.pack("<HQ", *item) for item in counts.items())
        file.write(record2(0x0B, numbers, text2(by_topic)))
        file.write(record2(2, u64(summary), u64(0), u32(0)) + magic)


def _chunk2(file: BinaryIO, given: list[Recorded]) -> bytes:
    """Write a chunk, and give the record of where it is and what it holds."""
    chunk, counts = bytearray(), dict[int, int]()
    for topic, when, data, hole in given:
        counts[topic] = counts.get(topic, 0) + 1
        head = struct.pack("<QHIQQ", 22 + len(data) + hole, topic, 0, when, when)
        chunk += b"\5" + head + data
    at, hole = file.tell(), given[-1].hole
    size, times = len(chunk) + hole, (given[0].when, given[-1].when)
    head = struct.pack("<QQQI", *times, size, 0) + text2("") + u64(size)
    file.write(b"\6" + u64(len(head) + size) + head + chunk)
    file.seek(hole, 1)
    offsets, begin = b"", file.tell()
    for topic, count in counts.items():
        offsets += struct.pack("<HQ", topic, file.tell())
        file.seek(15 + 16 * count, 1)
    where = (at, begin - at)
    whole = struct.pack("<QQQQ", *times, *where) + text2(offsets)
    return record2(8, whole, u64(file.tell() - begin), text2(""), u64(size), u64(size))


def main() -> None:
    """Write the bags, inspect them, and print how long it takes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--chunks", type=int, default=100_000)
    parser.add_argument("--gigabytes", type=float, default=80.0)
    parser.add_argument("--folder", type=Path, default=None, help="where to write the bags")
    options = parser.parse_args()
    size = round(options.gigabytes * 1e9 / options.chunks)
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        for name, write in (("large.bag", write_ros1), ("large.mcap", write_mcap)):
            path = Path(scratch, name)
            write(path, options.chunks, size)
            for _ in range(2):
                start = time.perf_counter()
                command = [sys.executable, "-m", "adaptune.commands.cli", "inspect", str(path)]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                seconds = time.perf_counter() - start
            what = f"{name}, {path.stat().st_size / 1e9:.0f} GB, {options.chunks:,} chunks"
            print(f"{what:40} {seconds:.2f} s (limit 3 s)", flush=True)
            path.unlink()


if __name__ == "__main__":
    main()
