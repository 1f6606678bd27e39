"""How fast recordings are read, against the least that reading them takes.

    python benchmarks/reading.py [--scans 200] [--large GIGABYTES] [--folder SCRATCH]

Writes bags of simulated VLP-16 clouds to a scratch folder, and prints a table. All on one thread;
every figure is the best of several runs.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from adaptune.sequence import SequenceConfig, open_sequence
from adaptune.sequence.pointcloud2 import decode

POINTS = 29_000
STEP = 22
FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7))
STORE = get_typestore(Stores.ROS1_NOETIC)
KIND = "sensor_msgs/msg/PointCloud2"


def cloud(rng: np.random.Generator, stamp: int) -> Any:
    """One turn of a VLP-16, as its driver publishes it."""
    names = [name for name, _, _ in FIELDS]
    formats = [{7: "<f4", 4: "<u2"}[kind] for _, _, kind in FIELDS]
    offsets = [offset for _, offset, _ in FIELDS]
    raw = np.zeros(
        POINTS,
        np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": STEP}),
    )
    for axis in "xyz":
        raw[axis] = rng.normal(0, 10, POINTS).round(3)
    raw["ring"] = np.arange(POINTS) % 16
    raw["time"] = np.linspace(0, 0.1, POINTS)
    types = STORE.types
    fields = [types["sensor_msgs/msg/PointField"](n, o, k, 1) for n, o, k in FIELDS]
    time_ = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    header = types["std_msgs/msg/Header"](0, time_, "velodyne")
    return types[KIND](
        header, 1, POINTS, fields, False, STEP, STEP * POINTS, raw.view(np.uint8), True
    )


def write(path: Path, scans: int, compression: Any = None) -> None:
    """Write a bag of so many scans."""
    rng = np.random.default_rng(0)
    kinds = [STORE.serialize_ros1(cloud(rng, 0), KIND) for _ in range(8)]
    with Writer(path) as writer:
        if compression is not None:
            writer.close  # noqa: B018
        connection = writer.add_connection("/velodyne_points", KIND, typestore=STORE)
        for i in range(scans):
            stamp = 10**18 + i * 10**8
            data = bytearray(kinds[i % len(kinds)])
            data[4:12] = np.array([stamp // 10**9, stamp % 10**9], "<u4").tobytes()
            writer.write(connection, stamp, data)


def least(path: Path) -> None:
    """Raw bytes, rosbags' messages, and one strided copy of each field that a scan has."""
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            for offset, kind in ((0, "<f4"), (4, "<f4"), (8, "<f4"), (16, "<u2"), (18, "<f4")):
                np.ndarray(POINTS, kind, message.data, offset, (STEP,)).copy()


def read(path: Path, cache: bool = False) -> None:
    """All scans of a bag."""
    for _ in open_sequence(SequenceConfig(bag=str(path), cache=cache)):
        pass


def best(function: Callable[[], object], runs: int = 7) -> float:
    """Seconds of the fastest run."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=200)
    parser.add_argument("--large", type=float, default=0.0, help="gigabytes of a bag to stream")
    parser.add_argument("--folder", type=Path, default=None)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        folder = Path(scratch)
        os.environ["ADAPTUNE_CACHE"] = str(folder / "cache")
        message = cloud(np.random.default_rng(0), 10**18)
        repeats = 50
        seconds = best(lambda: [decode(message) for _ in range(repeats)]) / repeats
        row("decode 29,000 points, ring and time", f"{seconds * 1e3:.3f} ms", "0.3 ms")
        for name, compression in (("uncompressed", None), ("LZ4", "LZ4"), ("BZ2", "BZ2")):
            path = folder / f"{name}.bag"
            scans = options.scans if name != "BZ2" else options.scans // 10
            write_compressed(path, scans, compression)
            ratios = sorted(
                best(lambda p=path: read(p), 3) / best(lambda p=path: least(p), 3)
                for _ in range(1 if name == "BZ2" else 5)
            )
            row(f"bag to clouds, {name}, of the least", f"{ratios[len(ratios) // 2]:.2f}", "1.15")
            path.unlink()
        reopen(folder)
        if options.large:
            large(folder, options.large)


def write_compressed(path: Path, scans: int, compression: str | None) -> None:
    """Write a bag with one kind of chunks."""
    rng = np.random.default_rng(0)
    kinds = [STORE.serialize_ros1(cloud(rng, 0), KIND) for _ in range(8)]
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connection = writer.add_connection("/velodyne_points", KIND, typestore=STORE)
        for i in range(scans):
            stamp = 10**18 + i * 10**8
            data = bytearray(kinds[i % len(kinds)])
            data[4:12] = np.array([stamp // 10**9, stamp % 10**9], "<u4").tobytes()
            writer.write(connection, stamp, data)


def row(what: str, measured: str, limit: str) -> None:
    """One line of the table."""
    print(f"{what:48} {measured:>12}   at most {limit}", flush=True)


if __name__ == "__main__":
    main()
