"""Damages messages, bags and studies at random, and looks at what the readers make of them.

    python tests/support/fuzz.py [--messages 8000] [--bags 2000] [--studies 4000] [--seed 0]

Whatever is damaged must become scans or a study that can be, or an error that says so: no other
exception, no crash, no more than a few seconds of the processor, no more than two gigabytes.
"""

import argparse
import contextlib
import faulthandler
import re
import resource
import signal
import struct
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import drives
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import get_types_from_msg

from adaptune.errors import AdaptuneError
from adaptune.recording import Scan, SequenceConfig, clouds
from adaptune.recording.clouds import PointCloudError
from adaptune.recording.export import Messages
from adaptune.recording.inspect import inspect, render_inspection
from adaptune.recording.recording import open_sequence
from offline.config import load_study

SECONDS, BYTES = 10, 2 << 30
START = 1_700_000_000_123_456_789
CLOUD, LIVOX = "sensor_msgs/msg/PointCloud2", clouds.LIVOX_TYPES[0]
# What a count or an offset is most wrong with.
WORDS = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF, 0x10000, 0x7FC00000, 0x7F800000)
LAYOUTS = {
    "velodyne": [*((a, "<f4") for a in "xyz"), ("ring", "<u2"), ("time", "<f4")],
    "plain": [(a, "<f4") for a in "xyz"],
}

# What a value of a study is most wrong with; RAN is the path of a file that code would make.
HOSTILE = (
    *("true", "false", "", "null", "''", "0", "-1", ".nan", "-.inf", "1e300", "1e-300", "1e400"),
    *("1" + "0" * 30, "1" + "0" * 400, "9" * 5000, "100000000", "abc", "1_0", "2001-01-01"),
    *("[]", "{}", "[[]]", "[{}]", "{a: 1}", "[1, true]", "&a [*a]", "*a", "[", "{", "- a", "? x"),
    *("~nobodyx/a.bag", "${NOPE}/a.bag", "/dev/zero", "..", "/", "'**/*'", "'['", "a" * 300),
    *("../x:y", "':'", "x:y", "math:sin", "os:system"),
    *("ünicode", "'\u202e'", '"\\0"', '"\\ud800"', "'a b/[c]'"),
    *("!!binary abc", "!!set {a}", "!!int x", "!!timestamp 2001-01-01", "!thing 3", "[" * 500),
    "!!python/object/apply:os.mkdir [RAN]",
    "!!python/object/new:os.system [mkdir RAN]",
    "!!python/name:os.system",
)
KEYS = ("descriptor", "health", "online", "isolation", "courses", "lost_track", "<<", "a", "1")
_VALUE = re.compile(r"(?<=[:\[,{] )[^\s,\[\]{}]+|(?<=[\[{])[^\s,\[\]{}:]+(?=[,\]])")

Decode = Callable[[bytes], Scan]


def stores() -> dict[bool, Messages]:
    """What makes messages of ROS 1 and of ROS 2, Livox's among them."""
    made = {False: Messages(1), True: Messages(2)}
    types: Any = {}
    for name, text in clouds.DEFINITIONS.items():
        types.update(get_types_from_msg(text, name))
    for messages in made.values():
        with contextlib.suppress(Exception):  # registered before
            messages.typestore.register(types)
    return made


def message(made: Messages, kind: str, stamp: int, rng: np.random.Generator, n: int = 30) -> Any:
    """A cloud or a Livox message of `n` points."""
    header = made.header("/points", stamp, "lidar")
    points = rng.normal(0, 10, (n, 3)).astype(np.float32)
    if kind == LIVOX:
        t = made.types
        each = [
            t[LIVOX.replace("Msg", "Point")](i * 1000, *map(float, p), 1, 2, i % 6)
            for i, p in enumerate(points)
        ]
        return t[LIVOX](header, stamp, n, 1, np.zeros(3, np.uint8), each)
    raw = np.zeros(n, LAYOUTS[kind])
    raw["x"], raw["y"], raw["z"] = points.T
    if kind == "velodyne":
        raw["ring"], raw["time"] = np.arange(n) % 16, np.linspace(0, 0.1, n)
    return made.cloud(header, raw)


def samples() -> Iterator[tuple[bytes, Decode]]:
    """Serialised messages of every kind, each with what decodes it."""
    rng = np.random.default_rng(0)
    for cdr, made in stores().items():
        store = made.typestore
        for kind in (*LAYOUTS, LIVOX):
            typename = LIVOX if kind == LIVOX else CLOUD
            sound = message(made, kind, START, rng)
            decode = partial(clouds.decode_livox if kind == LIVOX else clouds.decode_cloud, cdr=cdr)
            if cdr:
                yield bytes(store.serialize_cdr(sound, typename)), decode
                yield bytes(store.serialize_cdr(sound, typename, little_endian=False)), decode
            else:
                yield bytes(store.serialize_ros1(sound, typename)), decode


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """Flip, overwrite, lose, repeat or insert some bytes."""
    changed = bytearray(data)
    for _ in range(rng.integers(1, 4)):
        if not changed:
            break
        # Headers and indices lie at both ends.
        reach = min(len(changed), 300) if rng.random() < 0.4 else len(changed)
        at = int(rng.integers(reach))
        at = len(changed) - 1 - at if rng.random() < 0.3 else at
        match rng.choice(6, p=[0.3, 0.25, 0.3, 0.05, 0.05, 0.05]):
            case 0:
                changed[at] ^= 1 << int(rng.integers(8))
            case 1:
                changed[at] = int(rng.integers(256))
            case 2:
                word = struct.pack(str(rng.choice(["<I", ">I"])), int(rng.choice(WORDS)))
                changed[at : at + 4] = word[: len(changed) - at]
            case 3:
                del changed[at : at + int(rng.integers(1, 40))]
            case 4:
                changed[at:at] = changed[at : at + int(rng.integers(1, 40))]
            case _:
                del changed[max(at, 1) :]
    return bytes(changed)


def check(scan: Scan) -> None:
    """Make sure that a scan can be one."""
    assert np.isfinite(scan.points).all()
    assert (scan.points != 0).any(axis=1).all()
    for values in (scan.times, scan.rings, scan.intensities):
        assert values is None or (len(values) == len(scan) and np.isfinite(values).all())
    if scan.times is not None and len(scan):
        assert scan.times.min() >= 0
        assert scan.times.max() <= 10.001


def fuzz_messages(number: int, seed: int) -> Counter[str]:
    """Decode so many damaged messages, and count what became of them."""
    rng = np.random.default_rng(seed)
    sound = list(samples())
    counts: Counter[str] = Counter()
    for i in range(number):
        data, decode = sound[i % len(sound)]
        damaged = damage(data, rng)
        with case(f"message {i} of seed {seed}"):
            try:
                check(decode(damaged))
                counts["scans"] += 1
            except PointCloudError:
                counts["errors"] += 1
    return counts


def bags(folder: Path, scans: int = 16) -> list[Path]:
    """Bags of every format and compression; of ROS 2, the files themselves and their folders."""
    made = []
    rng = np.random.default_rng(0)
    for cdr, messages in stores().items():
        store = messages.typestore
        options: list[Any] = [None, "BZ2", "LZ4"]
        if cdr:
            options = [(s, c) for s in ("SQLITE3", "MCAP") for c in (None, "MESSAGE", "FILE")]
            options += [("MCAP", "STORAGE")]
        for option in options:
            path = folder / f"{'ros2' if cdr else 'ros1'}_{option}.bag".replace("'", "")
            path = path.with_suffix("") if cdr else path
            with _writer(path, cdr, option) as writer:
                topics = {
                    kind: writer.add_connection(f"/{name}", kind, typestore=store)
                    for name, kind in (("points", CLOUD), ("livox", LIVOX))
                }
                for i in range(scans):
                    stamp = START + i * 10**8
                    for kind, topic in topics.items():
                        layout = "velodyne" if kind == CLOUD else LIVOX
                        given = message(messages, layout, stamp, rng)
                        serialise = store.serialize_cdr if cdr else store.serialize_ros1
                        writer.write(topic, stamp, serialise(given, kind))
            made.append(path)
    return made


def fuzz_studies(number: int, seed: int, folder: Path) -> Counter[str]:
    """Read so many damaged studies, and count what became of them."""
    rng = np.random.default_rng(seed)
    sound = drives.write_study(folder).read_text("utf-8")
    ran, file = folder / "ran", folder / "damaged.yaml"
    counts: Counter[str] = Counter()
    for i in range(number):
        text = sound
        for _ in range(rng.integers(1, 4)):
            text = _worse(text, rng).replace("RAN", str(ran))
        file.write_text(text, "utf-8")
        said = ""
        with case(f"study {i} of seed {seed}:\n{text}"):
            try:
                load_study(file)
            except AdaptuneError as error:
                said = str(error)
            assert not ran.exists()
            assert not re.search("pydantic|Error:|Input should", said)
        counts["errors" if said else "studies"] += 1
    return counts


def _worse(text: str, rng: np.random.Generator) -> str:
    """Replace a value, give one more, or lose, repeat or damage a line."""
    lines = text.splitlines(keepends=True)
    at, hostile = int(rng.integers(len(lines))), str(rng.choice(HOSTILE))
    match rng.choice(5, p=[0.6, 0.15, 0.08, 0.07, 0.1]):
        case 0:
            places = list(_VALUE.finditer(text))
            if places:
                place = places[int(rng.integers(len(places)))]
                return f"{text[: place.start()]}{hostile}{text[place.end() :]}"
        case 1:
            lines.insert(at, f"{rng.choice(KEYS)}: {hostile}\n")
        case 2:
            del lines[at]
        case 3:
            lines.insert(at, lines[at])
        case _:
            lines[at] = damage(lines[at].encode(), rng).decode(errors="replace")
    return "".join(lines) or text


def _writer(path: Path, cdr: bool, option: Any) -> Any:
    if not cdr:
        writer = rosbag1.Writer(path)
        if option:
            writer.set_compression(rosbag1.Writer.CompressionFormat[option])
        return writer
    storage, mode = option
    plugin = rosbag2.StoragePlugin[storage]
    folder = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    if mode:
        folder.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
    return folder


@patch("adaptune.recording.inspect.SECONDS", 0.0)
def fuzz_bags(number: int, seed: int, folder: Path) -> Counter[str]:
    """Read so many damaged bags, and count what became of them; inspect samples of half of them."""
    rng = np.random.default_rng(seed)
    sound = bags(folder)
    counts: Counter[str] = Counter()
    for i in range(number):
        original = sound[i % len(sound)]
        files = sorted(original.iterdir()) if original.is_dir() else [original]
        hit = files[int(rng.integers(len(files)))]
        whole = hit.read_bytes()
        hit.write_bytes(damage(whole, rng))
        # A file is read alone as well as in its folder.
        bare = hit.suffix in (".mcap", ".db3") and rng.random() < 0.5
        path = hit if bare else original
        topic = str(rng.choice(["/points", "/livox"]))
        try:
            with case(f"bag {i} of seed {seed}, {path.name}"):
                try:
                    scans = list(
                        open_sequence(SequenceConfig(bag=str(path), points=topic, cache=False))
                    )
                    for scan in scans:
                        check(scan)
                    assert (np.diff([scan.stamp for scan in scans]) > 0).all()
                    counts["scans"] += 1
                except AdaptuneError:
                    counts["errors"] += 1
                with contextlib.suppress(AdaptuneError):
                    render_inspection(inspect(path, deep=i // len(sound) % 2 == 0))
        finally:
            hit.write_bytes(whole)
    return counts


@contextlib.contextmanager
def case(what: str) -> Iterator[None]:
    """Tell what was damaged where something goes wrong, and stop what does not end."""

    def late(*_: object) -> None:
        raise TimeoutError(f"took more than {SECONDS} s")

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    except Exception as error:
        raise AssertionError(f"{what}: {error!r}") from error
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def main() -> None:
    """Fuzz, and tell what became of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=8000)
    parser.add_argument("--bags", type=int, default=2000)
    parser.add_argument("--studies", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    faulthandler.enable()
    print(f"messages: {dict(fuzz_messages(options.messages, options.seed))}", flush=True)  # noqa: T201
    with tempfile.TemporaryDirectory() as folder:
        print(f"bags: {dict(fuzz_bags(options.bags, options.seed, Path(folder)))}")  # noqa: T201
    with tempfile.TemporaryDirectory() as folder:
        studies = fuzz_studies(options.studies, options.seed, Path(folder))
        print(f"studies: {dict(studies)}")  # noqa: T201
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"seed {options.seed}, peak memory {peak:.0f} MB")  # noqa: T201
    assert peak < BYTES >> 20


if __name__ == "__main__":
    main()
