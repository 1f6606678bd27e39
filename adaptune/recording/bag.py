"""Recordings in ROS 1 and ROS 2 bags."""

import errno
import logging
import math
import re
import resource
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache as once
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, IndexData, decompressors
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from adaptune.errors import AdaptuneError, Finding, blame_machine, nearest
from adaptune.recording import cache, clouds
from adaptune.recording.cache import status_key
from adaptune.recording.clouds import CLOUDS, PointCloudError, header_of
from adaptune.recording.config import files_of
from adaptune.recording.findings import clock_parts, of_clock
from adaptune.recording.pose_messages import (
    PATH,
    POSES,
    STATIC,
    TRANSFORMS,
    chained,
    message_stamp,
    of_frame,
    untimed,
    usable,
)
from adaptune.recording.scan import Frame, Imu, Scan, SequenceError
from adaptune.recording.timing import AUTO, Timing
from adaptune.trajectory import Trajectory

_log = logging.getLogger(__name__)

_LATEST, _UNEVEN = 600 * 10**9, 10**9
"""Nanoseconds from a bag's begin to its first scan, and by which scans come unevenly."""
IMU_TYPES = ("sensor_msgs/msg/Imu",)
Window = tuple[int | None, int | None]
"""Nanoseconds on the recorder's clock from which, and up to which, to read."""
_ALL: Window = (None, None)
# Nanoseconds: the end of a bag that is looked at, how late messages are written, and a long pause.
_LAST, _LATE, _PAUSE = 10 * 10**9, 5 * 10**7, 600 * 10**9
UNOPENED: Mapping[str, Any] = {
    "topics": {},
    "points": "",
    "n_messages": 0,
    "duration": 0,
    "begins": {},
    "window": _ALL,
    "skipped": 0.0,
    "findings": [],
}
"""In place of what opening bags has shown, see `BagSource.about`."""


def storages(reader: AnyReader) -> list[Any]:
    """What reads each file of open bags."""
    readers: Any = (getattr(one, "storage", one) for one in reader.readers)
    return [file for one in readers for file in getattr(one, "storages", [one])]


@once
def _typestore() -> Any:
    """Message definitions for ROS 2 bags that contain none."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, text in clouds.DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


_NOTHING = Chunk(0, 0, bytes)
_UNPACKED = 3.0
"""Times the size of a bag that BZ2 packs, its size without."""


class KeptReader(Reader):
    """Reads ROS 1 bags, and keeps in the cache what BZ2 had packed: to unpack that takes long."""

    def __init__(self, path: Path, keep: bool = True):
        super().__init__(path)
        self._folder = cache.folder() / cache.key([path], "unpacked")
        self._room = round(_UNPACKED * path.stat().st_size)
        self._keep = keep and self._room < cache.cap()

    def read_chunk(self) -> Chunk:
        """Where a chunk is, and what unpacks it."""
        chunk = super().read_chunk()
        if not self._keep or chunk.decompressor is not decompressors["bz2"]:
            return chunk
        given = self._folder / str(chunk.datapos), self._room, chunk.decompressor
        return chunk._replace(decompressor=partial(cache.unpacked, *given))


class IndexReader(KeptReader):
    """Reads ROS 1 bags that are opened by the index at their end alone.

    rosbags visits every chunk when it opens a bag, which takes seconds for 100,000 of them.
    """

    def open(self) -> None:
        """Read the list of chunks."""
        super().open()
        counts: Counter[int] = Counter()
        for info in self.chunk_infos:
            for connection, count in info.connection_counts.items():
                counts[connection] += count
        self.connections = [c._replace(msgcount=counts[c.id]) for c in self.connections]

    def read_chunk(self) -> Chunk:
        """Nothing, while the bag is opened."""
        return _NOTHING

    def read_index_data(self, pos: int, indexes: dict[int, list[IndexData]]) -> None:
        """Nothing, while the bag is opened."""

    def is_slow(self) -> bool:
        """Whether its first chunk is packed by BZ2, which unpacks a few megabytes a second."""
        if not self.chunk_infos:
            return False
        assert self.bio is not None
        self.bio.seek(self.chunk_infos[0].pos)
        return Reader.read_chunk(self).decompressor is decompressors["bz2"]

    def messages(
        self,
        connections: Collection[Connection] = (),
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[tuple[Connection, int, bytes], None, None]:
        """Messages of some time, as rosbags gives them."""
        assert self.bio is not None
        indexes: dict[int, list[IndexData]] = defaultdict(list)
        for info in self.chunk_infos:
            if (start is None or info.end_time > start) and (
                stop is None or info.start_time < stop
            ):
                self.bio.seek(info.pos)
                self.chunks[info.pos] = super().read_chunk()
                for _ in info.connection_counts:
                    super().read_index_data(info.pos, indexes)
        self.indexes = {c.id: sorted(indexes[c.id]) for c in self.connections}
        yield from super().messages(connections, start, stop)


_shown: dict[tuple[object, ...], Mapping[str, Any]] = {}
"""What opening bags has shown in this process, by their files."""
_poses: dict[tuple[object, ...], Trajectory] = {}
_MOST_POSES = 32
"""Those that were read last, by files and topic, and how many of them are kept."""


class BagSource:
    """Scans, IMU and poses of one or more bags that follow each other.

    All methods raise a SequenceError where the bags cannot be opened or read, lack a topic, or hold
    no usable message on it. It names the bags and the message, or the topics that there are.

    `paths` are as `bag_paths` gives them. The topic of the point clouds may be left out where there
    is only one, and their frame where the topic has only one. Given the result of `about`, or where
    the same bags were opened before, they are not opened now. What BZ2 packs is unpacked once if
    `keep`, and kept in the cache.
    """

    pose_files: Sequence[Path] = ()

    def __init__(
        self,
        paths: Sequence[Path],
        points: str | None = None,
        timing: Timing = AUTO,
        frame: str | None = None,
        about: Mapping[str, Any] | None = None,
        within: tuple[float, float] = (0.0, math.inf),
        keep: bool = True,
    ):
        self.paths, self.timing, self.frame = tuple(paths), timing, frame
        self._keep = keep
        key = (*map(status_key, self.files), points, within)
        about = _shown.get(key) if about is None else about
        given = UNOPENED if about is None else about
        self.topics: dict[str, str] = dict(given["topics"])
        self.points: str = given["points"]
        self.n_messages: int = given["n_messages"]
        self._duration: int = given["duration"]
        self.begins: dict[str, int] = dict(given["begins"])
        # Nanoseconds on the recorder's clock of what is used, and seconds before it.
        self.window: Window = tuple(given["window"])
        self.skipped: float = given["skipped"]
        self.findings = [Finding((), text, of="points") for text in given["findings"]]
        if about is not None:
            return
        with self.open() as reader:
            self.topics = {c.topic: c.msgtype for c in reader.connections}
            self.points = self.topic(points, CLOUDS, "point clouds")
            self.n_messages = sum(c.msgcount for c in reader.connections if c.topic == self.points)
            self._duration = max(reader.end_time - reader.start_time, 0)
            known = [t for t, kind in self.topics.items() if t == self.points or kind in POSES]
            begins = {topic: self._begin(reader, topic) for topic in known}
            self.begins = {topic: stamp for topic, stamp in begins.items() if stamp is not None}
            self.look_at_clock(reader, within)
        _shown[key] = self.about()

    def about(self) -> dict[str, Any]:
        """Everything that opening the bags has shown, as plain data."""
        return {
            "name": self.name,
            "topics": self.topics,
            "points": self.points,
            "n_messages": self.n_messages,
            "duration": self._duration,
            "begins": self.begins,
            "window": self.window,
            "skipped": self.skipped,
            "findings": [str(finding) for finding in self.findings],
        }

    def look_at_clock(
        self, reader: AnyReader, within: tuple[float, float] = (0.0, math.inf)
    ) -> None:
        """Where the clock leaps, use the longest part between the seconds `within`."""
        if not self._leaps(reader):
            return
        stamps, recorded = np.array(list(self._clocks(reader)), np.int64).reshape(-1, 2).T
        parts = clock_parts(stamps, recorded)
        lasts = [min(p.seconds[1], within[1]) - max(p.seconds[0], within[0]) for p in parts]
        long = [-1.0 if part.twice else last for part, last in zip(parts, lasts, strict=True)]
        if len(parts) < 2 or max(long) < 0:
            return
        used = parts[int(np.argmax(long))]
        end = int(recorded[used.last]) if used.last < len(stamps) else None
        self.window, self.skipped = (int(recorded[used.first]), end), used.seconds[0]
        self.begins[self.points] = int(stamps[used.first])
        self._duration = int(stamps[used.last - 1] - stamps[used.first])
        self.n_messages = used.last - used.first
        self.findings = [of_clock(self.points, parts, used)]

    def _clocks(self, reader: AnyReader, span: Window = _ALL) -> Iterator[tuple[int, int]]:
        """Stamps of the scans, and when they were recorded, up to where the bag is damaged."""
        with suppress(SequenceError):
            for _, recorded, data in self.read(reader, self.points, span):
                stamp = header_of(data, reader.is2)[0]
                if stamp is not None:
                    yield stamp, recorded

    def _leaps(self, reader: AnyReader) -> bool:
        """Whether a clock may leap: the sensor's against the recorder's, or this in the files."""
        if not self.points or reader.start_time >= reader.end_time:
            return False
        tail: Window = (reader.end_time - min(_LAST, reader.duration // 4), None)
        ends = [end for span in (_ALL, tail) for end in islice(self._clocks(reader, span), 1)]
        ahead = [stamp - recorded for stamp, recorded in ends]
        if ends and abs(ahead[-1] - ahead[0]) > 1e9 + 1e-3 * reader.duration:
            return True
        # Chunks in the order in which they were written, as far as there are any.
        for file in storages(reader):
            if (database := getattr(file, "dbconn", None)) is not None:
                rows = database.execute("SELECT timestamp FROM messages ORDER BY rowid")
                spans = [(time, time) for (time,) in rows]
            elif (chunks := getattr(file, "chunk_infos", None)) is not None:
                chunks = sorted(chunks, key=lambda c: c.pos)
                spans = [(c.start_time, c.end_time) for c in chunks]
            else:
                chunks = sorted(file.chunks, key=lambda c: c.chunk_start_offset)
                spans = [(c.message_start_time, c.message_end_time) for c in chunks]
            steps = [after[0] - before[1] for before, after in pairwise(spans)]
            longest = max([*steps, *(end - begin for begin, end in spans)], default=0)
            if min(steps, default=0) < -_LATE or longest > _PAUSE:
                return True
        return False

    @property
    def name(self) -> str:
        """The bag's file; the first one's, and how many more there are."""
        more = f" (and {len(self.paths) - 1} more)" if len(self.paths) > 1 else ""
        return f"{self.paths[0]}{more}"

    @property
    def files(self) -> list[Path]:
        """The files of all bags."""
        return files_of(self.paths)

    def frames(self) -> Iterator[Frame]:
        """All scans in the order of their recording."""
        with self.open() as reader:
            load, frames, wanted = self.loader(reader), set[str](), (self.frame or "").lstrip("/")
            messages = enumerate(self.read(reader, self.points, self.window), start=1)
            for number, (connection, recorded, data) in messages:
                what = f"{self.name}: message {number} on {self.points}"
                stamp, frame = header_of(data, reader.is2)
                if stamp is None:
                    raise SequenceError(f"{what} is cut short")
                frames.add(frame)
                if not wanted and len(frames) > 1:
                    break
                if wanted in ("", frame):
                    yield Frame(stamp, recorded, partial(load, connection.msgtype, data, what))
        wrong = wanted not in frames if wanted else len(frames) > 1
        if frames and wrong:
            what = f"{self.points} holds clouds of {', '.join(sorted(map(repr, frames)))}"
            raise SequenceError(f"{self.name}: {what}; name one of these frames as `frame`")

    def between(self, begin: int, stop: int) -> list[Frame]:
        """Scans with stamps from `begin` to before `stop`, found by the bags' index."""
        frames = list[Frame]()
        with self.open(by_index=True) as reader:
            load, first = self.loader(reader), self.window[0] or reader.start_time
            soon = first, first + _LATEST
            for _, recorded, data in islice(self.read(reader, self.points, soon), 1):
                late = recorded - (header_of(data, reader.is2)[0] or 0)
                span = begin + late - _UNEVEN, stop + late + _UNEVEN
                for connection, when, message in self.read(reader, self.points, span):
                    stamp = header_of(message, reader.is2)[0] or 0
                    if begin <= stamp < stop:
                        kind = connection.msgtype
                        frames.append(Frame(stamp, when, partial(load, kind, message, self.name)))
        return frames

    def _begin(self, reader: AnyReader, topic: str) -> int | None:
        """Stamp of the first message, if it has one. Reading the bag reports why it has none."""
        try:
            connection, _, data = next(self.read(reader, topic))
            if topic == self.points:
                return header_of(data, reader.is2)[0]
            message = reader.deserialize(data, connection.msgtype)
            return POSES[connection.msgtype](message)[0][0]
        except Exception:
            return None

    def span(self) -> tuple[int, int] | None:
        """First stamp, and the last one if the recorder's clock went as the sensor's."""
        first = self.begins.get(self.points)
        return None if first is None else (first, first + self._duration)

    def poses(
        self, name: str | None, child_frame: str | None, strict: bool = False
    ) -> Trajectory | None:
        """Poses on a topic, those with the same stamp once; of paths, the last one recorded.

        The frame of transforms may be a chain, as ``map.base_link``. Of two nodes that publish on
        a topic, the one with more poses counts, or if `strict` none.
        """
        if name is None:
            return None
        name = self.topic(name, POSES, "poses")
        # They are asked for again and again, and to unpack a bag may take minutes.
        key = (*map(status_key, self.files), name, child_frame, strict)
        if key not in _poses:
            if len(_poses) >= _MOST_POSES:
                _poses.clear()
            _poses[key] = self._poses(name, child_frame, strict)
        return _poses[key]

    def _poses(self, name: str, child_frame: str | None, strict: bool) -> Trajectory:
        messages = self.messages(name, last=self.topics[name] == PATH)
        found = [pose for message in messages for pose in POSES[message.__msgtype__](message)]
        if self.topics[name] in TRANSFORMS and "." in (child_frame or ""):
            return self._chain(name, str(child_frame))
        if self.topics[name] in TRANSFORMS:
            found = of_frame(f"{self.name}: {name}", found, child_frame)
        if not found:
            raise SequenceError(f"{self.name}: no pose on {name}; name another `reference`")
        if what := untimed(found):
            raise SequenceError(f"{self.name}: {name}: {what}; name another `reference`")
        if strict and len(frames := sorted({frame for _, frame, *_ in found})) > 1:
            what = f"has poses of {' and '.join(map(repr, frames))}: two nodes publish there"
            raise SequenceError(f"{self.name}: {name} {what}; record each on a topic of its own")
        trajectory, left_out = usable(found)
        if trajectory is None:
            raise SequenceError(f"{self.name}: {name}: {left_out[-1]}")
        for what in left_out:
            _log.warning("%s: %s: %s; they are left out", self.name, name, what)
        return trajectory

    def _chain(self, name: str, frames: str) -> Trajectory:
        """Poses along a chain of transforms, which may be fixed in part."""
        every = [t for message in self.messages(name) for t in message.transforms]
        fixed = self.messages(STATIC) if self.topics.get(STATIC) in TRANSFORMS else ()
        always = [t for message in fixed for t in message.transforms]
        try:
            return chained(every, always, *frames.split(".", 1))
        except ValueError as error:
            raise SequenceError(f"{self.name}: {name}: {error}") from error

    def fixed_frames(self) -> tuple[str, dict[str, tuple[str, list[float]]]]:
        """The clouds' frame, and frames of ``/tf_static``, each with its parent and pose in that.

        A pose is x, y, z in metres and a quaternion with its real part last.
        """
        with self.open() as reader:
            clouds = islice(self.read(reader, self.points), 1)
            frame = next((header_of(data, reader.is2)[1] for _, _, data in clouds), "")
        fixed: dict[str, tuple[str, list[float]]] = {}
        if self.topics.get(STATIC) not in TRANSFORMS:
            return frame, fixed
        for stamped in (t for message in self.messages(STATIC) for t in message.transforms):
            p, q = stamped.transform.translation, stamped.transform.rotation
            pose = [round(float(v), 9) for v in (p.x, p.y, p.z, q.x, q.y, q.z, q.w)]
            fixed[stamped.child_frame_id] = stamped.header.frame_id, pose
        return frame, fixed

    def imu(self, name: str | None) -> Imu | None:
        """Measurements on a topic, as they were recorded."""
        name = self.topic(name, IMU_TYPES, "an IMU's measurements")
        stamps, values = [], []
        for message in self.messages(name):
            w, a = message.angular_velocity, message.linear_acceleration
            stamps.append(message_stamp(message))
            values.append((w.x, w.y, w.z, a.x, a.y, a.z))
        if not stamps:
            raise SequenceError(f"{self.name}: no measurement on {name}; name another topic")
        unique, index = np.unique(np.array(stamps, np.int64), return_index=True)
        measured = np.array(values)[index]
        if not np.isfinite(measured).all():
            raise SequenceError(f"{self.name}: a measurement on {name} is not finite")
        return Imu(unique, measured[:, :3], measured[:, 3:])

    def topic(self, name: str | None, types: Iterable[str], what: str) -> str:
        """The topic of this name, or the only one of these types."""
        types = tuple(types)
        fitting = sorted(t for t, kind in self.topics.items() if kind in types)
        if name is None:
            if len(fitting) != 1:
                help_ = f", name one of them: {', '.join(fitting)}" if fitting else self._list()
                raise SequenceError(f"{self.name}: {len(fitting)} topics with {what}{help_}")
            return fitting[0]
        if name in fitting:
            return name
        if name in self.topics:
            raise SequenceError(f"{self.name}: {name} is {self.topics[name]}, not {what}")
        help_ = nearest(name, self.topics) + self._list()
        raise SequenceError(f"{self.name}: no topic {name}; {help_}")

    def _list(self) -> str:
        topics = sorted(f"{topic} ({kind})" for topic, kind in self.topics.items())
        return f"; it holds {', '.join(topics) or 'nothing'}"

    def messages(self, topic: str, last: bool = False) -> Iterator[Any]:
        """Deserialised messages of a topic, or its last one only."""
        with self.open() as reader:
            window = self.window
            if window != _ALL and next(self.read(reader, topic, window), None) is None:
                window = _ALL  # a reference that was added later
            messages: Iterable[Any] = enumerate(self.read(reader, topic, window), start=1)
            if last:
                messages = deque(messages, maxlen=1)
            for number, (connection, _, data) in messages:
                try:
                    yield reader.deserialize(data, connection.msgtype)
                except Exception as error:
                    what = f"message {number} on {topic} is damaged ({error})"
                    raise SequenceError(f"{self.name}: {what}") from error

    @contextmanager
    def open(self, by_index: bool = False) -> Iterator[AnyReader]:
        """Open the bags for reading; `by_index`, without a look at their chunks."""
        for database in (file for file in self.files if file.suffix == ".db3"):
            for journal in (Path(f"{database}-wal"), Path(f"{database}-journal")):
                if journal.exists() and journal.stat().st_size:
                    raise SequenceError(
                        f"{journal}: holds messages that are not in the bag yet, as its recorder "
                        f"was killed; add them by `sqlite3 {database} 'pragma wal_checkpoint'`"
                    )
        try:
            reader = AnyReader(self.paths, default_typestore=_typestore())
            if not reader.is2:
                kind = IndexReader if by_index else KeptReader
                reader.readers = [kind(path, self._keep) for path in self.paths]
            reader.open()
            if not all(isinstance(c.msgcount, int) for c in reader.connections):
                raise TypeError("metadata.yaml counts in no numbers")  # noqa: TRY301
        except AdaptuneError:  # of the cache
            raise
        except Exception as error:
            # The readers raise what their formats and decompressors raise.
            # SQLite does not say why it cannot open a file.
            most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
            full = 0 < most < len(files_of(self.paths)) + 32
            blame_machine(self.name, OSError(errno.EMFILE, "") if full else error)
            if re.search("File magic is|not a database", str(error)):
                what = "is no bag, whatever its name says; give the recording itself"
                raise SequenceError(f"{self.name}: {what}") from error
            beside = (self.paths[0].with_suffix(suffix) for suffix in (".tum", ".json"))
            tools = "`rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
            help_ = f"if the recording was cut short, repair it first ({tools})"
            if all(map(Path.exists, beside)):  # as of a simulated course
                help_ += "; a simulated course is recorded anew by `adaptune simulate --overwrite`"
            what = f"cannot be opened as a bag ({_say(error)}); {help_}"
            raise SequenceError(f"{self.name}: {what}") from error
        try:
            yield reader
        finally:
            reader.close()

    def read(
        self, reader: AnyReader, topic: str | None = None, span: Window = _ALL
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Serialised messages of a topic, or of all topics; `span`, those recorded then."""
        chosen = [c for c in reader.connections if topic in (None, c.topic)]
        messages = reader.messages(chosen, *span)
        while True:
            try:
                message = next(messages)
                len(message[2])  # a row of a damaged database may hold none
            except StopIteration:
                return
            except Exception as error:
                blame_machine(self.name, error)
                help_ = "the bag is damaged, `stop` before the damage or repair it"
                raise SequenceError(
                    f"{self.name}: the rest cannot be read ({_say(error)}); {help_}"
                ) from error
            yield message

    def loader(self, reader: AnyReader) -> Callable[[str, bytes, str], Scan]:
        """What decodes a message of a type; the message's name goes into the SequenceError."""
        return partial(_load, reader.is2, self.timing)


def _load(cdr: bool, timing: Timing, kind: str, data: bytes, what: str) -> Scan:
    if kind not in CLOUDS:
        raise SequenceError(f"{what} is {kind}, not a point cloud: another node wrote there")
    try:
        return CLOUDS[kind](data, cdr, timing)
    except PointCloudError as error:
        raise SequenceError(f"{what}: {error}") from error
    except Exception as error:
        blame_machine(what, error)
        raise SequenceError(f"{what}: damaged ({_say(error)})") from error


def _say(error: Exception) -> str:
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__
