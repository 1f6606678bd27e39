"""Damages messages, bags and studies at random, and looks at what the readers make of them.

Whatever is damaged must become scans or a study that can be, or an error that says so: no other
exception, no crash, no more than a few seconds of the processor. `benchmarks/fuzz.py` takes longer.
"""

import contextlib
import re
import signal
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import drives
import numpy as np
import rec

from adaptune.errors import AdaptuneError
from adaptune.recording import Scan, SequenceConfig, clouds
from adaptune.recording.inspect import inspect
from adaptune.recording.recording import open_sequence
from adaptune.recording.rendering import render_inspection
from offline.config import load_study

SECONDS = 10
CLOUD, LIVOX = "sensor_msgs/msg/PointCloud2", clouds.LIVOX_TYPES[0]
# What a count or an offset is most wrong with.
WORDS = (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFE, 0xFFFFFFFF, 0x10000, 0x7FC00000, 0x7F800000)
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
Case = Callable[[np.random.Generator], object]
"""Damages something and reads it; it raises an `AdaptuneError`, or returns what was read."""


def message(store: Any, kind: str, stamp: int, rng: np.random.Generator) -> Any:
    """A cloud, `plain` or of a `velodyne`, or a Livox message of 30 points."""
    points = rng.normal(0, 10, (30, 3)).astype("<f4")
    if kind == "velodyne":
        return rec.cloud(rec.velodyne(points), stamp, store)
    if kind == "plain":
        return rec.cloud(points.view([(axis, "<f4") for axis in "xyz"])[:, 0], stamp, store)
    return rec.livox(store, LIVOX, points, stamp)


def samples() -> Iterator[tuple[bytes, Decode]]:
    """Serialised messages of every kind, each with what decodes it."""
    rng = np.random.default_rng(0)
    for store in (rec.ROS1, rec.ROS2):
        for kind in ("velodyne", "plain", LIVOX):
            typename = LIVOX if kind == LIVOX else CLOUD
            sound = message(store, kind, rec.START, rng)
            read = clouds.decode_livox if kind == LIVOX else clouds.decode_cloud
            if store is rec.ROS1:
                yield bytes(store.serialize_ros1(sound, typename)), partial(read, cdr=False)
                continue
            for little in (True, False):
                data = store.serialize_cdr(sound, typename, little_endian=little)
                yield bytes(data), partial(read, cdr=True)


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


def of_messages(_: Path | None = None) -> Case:
    """Decodes damaged messages."""
    sound = list(samples())

    def one(rng: np.random.Generator) -> None:
        data, decode = sound[int(rng.integers(len(sound)))]
        check(decode(damage(data, rng)))

    return one


def bags(folder: Path, scans: int = 16) -> list[Path]:
    """Bags of every format and compression; of ROS 2, the files themselves and their folders."""
    made = []
    rng = np.random.default_rng(0)
    kinds = [("bag", how) for how in (None, "BZ2", "LZ4")]
    kinds += [(kind, how) for kind in ("sqlite3", "mcap") for how in (None, "MESSAGE", "FILE")]
    for kind, compression in (*kinds, ("mcap", "STORAGE")):
        path = folder / f"{compression}.{kind}"
        messages = [
            (topic, stamp, message(rec.store_of(path), layout, stamp, rng))
            for stamp in range(rec.START, rec.START + scans * 10**8, 10**8)
            for topic, layout in (("/points", "velodyne"), ("/livox", LIVOX))
        ]
        made.append(rec.write_bag(path, messages, compression))
    return made


def of_studies(folder: Path) -> Case:
    """Reads damaged studies."""
    sound = drives.write_study(folder).read_text("utf-8")
    ran, file = folder / "ran", folder / "damaged.yaml"

    def one(rng: np.random.Generator) -> None:
        text = sound
        for _ in range(rng.integers(1, 4)):
            text = _worse(text, rng).replace("RAN", str(ran))
        file.write_text(text, "utf-8")
        said = ""
        try:
            load_study(file)
        except AdaptuneError as error:
            said = str(error)
            raise
        finally:
            assert not ran.exists(), text
            assert not re.search("pydantic|Error:|Input should", said), text

    return one


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


def of_bags(folder: Path) -> Case:
    """Inspects damaged bags, samples of half of them, and reads them."""
    sound = bags(folder)

    @patch("adaptune.recording.inspect.SECONDS", 0.0)
    def one(rng: np.random.Generator) -> None:
        original = sound[int(rng.integers(len(sound)))]
        files = sorted(original.iterdir()) if original.is_dir() else [original]
        hit = files[int(rng.integers(len(files)))]
        whole = hit.read_bytes()
        hit.write_bytes(damage(whole, rng))
        # A file is read alone as well as in its folder.
        bare = hit.suffix in (".mcap", ".db3") and rng.random() < 0.5
        path = str(hit if bare else original)
        topic = str(rng.choice(["/points", "/livox"]))
        try:
            with contextlib.suppress(AdaptuneError):
                render_inspection(inspect(Path(path), deep=rng.random() < 0.5))
            scans = list(open_sequence(SequenceConfig(bag=path, points=topic, cache=False)))
            for scan in scans:
                check(scan)
            assert (np.diff([scan.stamp for scan in scans]) > 0).all()
        finally:
            hit.write_bytes(whole)

    return one


def counted(one: Case, seed: int, numbers: Iterable[int]) -> Counter[str]:
    """Count what became of the cases of these numbers: they were read, or gave errors."""
    counts: Counter[str] = Counter()
    for number in numbers:
        with case(f"case {number} of seed {seed}"):
            try:
                one(np.random.default_rng((seed, number)))
                counts["read"] += 1
            except AdaptuneError:
                counts["errors"] += 1
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
