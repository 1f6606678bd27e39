"""How fast recordings are read, against the least time that reading them takes.

    python benchmarks/reading.py [--scans 500] [--large 10] [--folder SCRATCH]

The script writes bags of random VLP-16 clouds to a scratch folder, and prints a table. All runs on
one thread; every figure is the best of several runs.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from adaptune.recording import SequenceConfig
from adaptune.recording.clouds import decode_cloud
from adaptune.recording.recording import open_sequence

POINTS = 29_000
STEP = 22
FIELDS = (
    ("x", 0, 7),
    ("y", 4, 7),
    ("z", 8, 7),
    ("intensity", 12, 7),
    ("ring", 16, 4),
    ("time", 18, 7),
)
KINDS = ("<f4", "<f4", "<f4", "<f4", "<u2", "<f4")
STORE = get_typestore(Stores.ROS1_NOETIC)
KIND = "sensor_msgs/msg/PointCloud2"


def cloud(
    rng: np.random.Generator, stamp: int, points: int = POINTS, xyz: NDArray[Any] | None = None
) -> Any:
    """One turn of a VLP-16, as its driver publishes it: of noise, unless it is given."""
    names = [name for name, _, _ in FIELDS]
    formats = [{7: "<f4", 4: "<u2"}[kind] for _, _, kind in FIELDS]
    offsets = [offset for _, offset, _ in FIELDS]
    raw = np.zeros(
        points,
        np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": STEP}),
    )
    given = rng.normal(0, 10, (points, 3)).round(3) if xyz is None else xyz
    for axis, column in zip("xyz", given.T, strict=True):
        raw[axis] = column
    raw["ring"] = np.arange(points) % 16
    raw["time"] = np.linspace(0, 0.1, points)
    types = STORE.types
    fields = [types["sensor_msgs/msg/PointField"](n, o, k, 1) for n, o, k in FIELDS]
    time_ = types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    header = types["std_msgs/msg/Header"](0, time_, "velodyne")
    return types[KIND](
        header, 1, points, fields, False, STEP, STEP * points, raw.view(np.uint8), True
    )


def least(path: Path) -> None:
    """Raw bytes, rosbags' messages, and one strided copy of each field that a scan has."""
    scan = None
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            # As with any reader, a scan lives until the next one is there.
            scan = [
                np.ndarray(POINTS, kind, message.data, offset, (STEP,)).copy()
                for offset, kind in zip((0, 4, 8, 12, 16, 18), KINDS, strict=True)
            ]
    assert scan is not None


def read(path: Path, cache: bool = False) -> None:
    """All scans of a bag."""
    for _ in open_sequence(SequenceConfig(bag=str(path), cache=cache)):
        pass


def best(function: Callable[[], object], runs: int = 7) -> float:
    """CPU seconds of the fastest run: other work on the machine does not count."""
    times = []
    for _ in range(runs):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=500)
    parser.add_argument("--large", type=float, default=0.0, help="gigabytes of a bag to stream")
    parser.add_argument("--folder", type=Path, default=None, help="where to write the bags")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as scratch:
        folder = Path(scratch)
        os.environ["ADAPTUNE_CACHE"] = str(folder / "cache")
        decoding()
        for compression in (None, "LZ4", "BZ2"):
            scans = options.scans if compression != "BZ2" else options.scans // 10
            reading(folder / "a.bag", scans, compression)
        reopening(folder / "b.bag", 10_000)
        if options.large:
            streaming(folder / "c.bag", options.large)


def decoding() -> None:
    """One message to one scan."""
    data = bytes(STORE.serialize_ros1(cloud(np.random.default_rng(0), 10**18), KIND))

    def many() -> None:
        for _ in range(50):
            decode_cloud(data, cdr=False)

    row("decode 29,000 points, ring and time", f"{best(many, 20) / 50 * 1e3:.3f} ms", "0.3 ms")


def reading(path: Path, scans: int, compression: str | None) -> None:
    """A whole bag, in turns with the least, so that other work slows both alike."""
    write(path, scans, compression)
    ours, theirs = [], []
    for _ in range(9 if compression != "BZ2" else 2):
        ours.append(best(lambda: read(path), 1))
        theirs.append(best(lambda: least(path), 1))
    what = f"bag to clouds, {compression or 'uncompressed'}"
    per_scan = min(ours) / scans * 1e3
    row(what, f"{per_scan:.3f} ms", f"{min(ours) / min(theirs):.2f} of the least (limit 1.15)")
    path.unlink()


def reopening(path: Path, scans: int) -> None:
    """Opening a decoded sequence again, to its last scan's points."""
    write(path, scans, points=300)
    read(path, cache=True)

    def again() -> None:
        sequence = open_sequence(SequenceConfig(bag=str(path)))
        for scan in sequence:
            scan.points.sum()

    opened = best(lambda: next(iter(open_sequence(SequenceConfig(bag=str(path))))))
    row("open 10,000 cached scans, to the first", f"{opened * 1e3:.1f} ms", "200 ms")
    row("  and to the last", f"{best(again) * 1e3:.1f} ms", "-")
    path.unlink()


def streaming(path: Path, gigabytes: float) -> None:
    """Memory of one pass over a large bag, in a process of its own."""
    write(path, round(gigabytes * 1e9 / (POINTS * STEP)))
    code = (
        "import resource, sys; from adaptune.recording import SequenceConfig\n"
        "from adaptune.recording.recording import open_sequence\n"
        "n = sum(1 for _ in open_sequence(SequenceConfig(bag=sys.argv[1], cache=False)))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    start = time.perf_counter()
    peak = subprocess.run(
        [sys.executable, "-c", code, str(path)], check=True, capture_output=True, text=True
    ).stdout
    seconds = time.perf_counter() - start
    row(
        f"memory of a pass over {gigabytes:g} GB",
        f"{float(peak):.0f} MB",
        f"500 MB ({seconds:.0f} s)",
    )


def write(
    path: Path,
    scans: int,
    compression: str | None = None,
    points: int = POINTS,
    clouds: Sequence[Any] = (),
) -> None:
    """Write a bag of so many scans: of noise, or of clouds that come again and again."""
    rng = np.random.default_rng(0)
    clouds = clouds or [cloud(rng, 0, points) for _ in range(8)]
    kinds = [STORE.serialize_ros1(each, KIND) for each in clouds]
    writer = Writer(path)
    if compression:
        writer.set_compression(Writer.CompressionFormat[compression])
    with writer:
        connection = writer.add_connection("/velodyne_points", KIND, typestore=STORE)
        for i in range(scans):
            stamp = 10**18 + i * 10**8
            data = bytearray(kinds[i % len(kinds)])
            # The stamp of the header, behind its sequence number.
            data[4:12] = np.array([stamp // 10**9, stamp % 10**9], "<u4").tobytes()
            writer.write(connection, stamp, data)


def row(what: str, measured: str, limit: str) -> None:
    """One line of the table."""
    print(f"{what:42} {measured:>10}   {limit}", flush=True)


if __name__ == "__main__":
    main()
