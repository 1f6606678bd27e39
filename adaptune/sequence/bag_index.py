"""ROS 1 bags that are opened by the index at their end alone."""

import struct
from collections import Counter, defaultdict
from collections.abc import Collection, Generator

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, ChunkInfo, IndexData, decompressors

_WORD = struct.Struct("<I").unpack_from
_NOTHING = Chunk(0, 0, bytes)
_KINDS = {b"op": "B", b"ver": "I", b"chunk_pos": "Q", b"count": "I"}
_TIMES = (b"start_time", b"end_time")

Layout = tuple[struct.Struct, list[int]]
"""How to unpack the header of a record, and which of the values is which."""


class IndexReader(Reader):
    """Looks a chunk up only when messages of its time are asked for.

    rosbags visits every chunk when it opens a bag, which takes seconds for 100,000 of them. What
    they hold is also listed at the end of the file.
    """

    def open(self) -> None:
        """Read the list of chunks."""
        self._layout: Layout | None = None
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

    def read_chunk_info(self) -> ChunkInfo:
        """Read a record in a sixth of the time, if it is laid out as the one before."""
        assert self.bio is not None
        word = self.bio.read(4)
        header = self.bio.read(*_WORD(word)) if len(word) == 4 else b""
        if self._layout is None or len(header) != self._layout[0].size:
            self._layout = _layout(header)
            self.bio.seek(-len(header) - len(word), 1)
            return super().read_chunk_info()
        values = self._layout[0].unpack(header)
        op, ver, pos, count, start, start_ns, end, end_ns = [values[i] for i in self._layout[1]]
        counts = self.bio.read(4 + 8 * count)
        if (op, ver, len(counts)) != (6, 1, 4 + 8 * count) or not count:
            self.bio.seek(-len(counts) - len(header) - len(word), 1)
            return super().read_chunk_info()
        numbers = struct.unpack_from(f"<{2 * count}I", counts, 4)
        by_connection = dict(zip(numbers[::2], numbers[1::2], strict=True))
        return ChunkInfo(pos, start * 10**9 + start_ns, end * 10**9 + end_ns + 1, by_connection)

    def is_slow(self) -> bool:
        """Whether its first chunk is packed by BZ2, which unpacks a few megabytes a second."""
        if not self.chunk_infos:
            return False
        assert self.bio is not None
        self.bio.seek(self.chunk_infos[0].pos)
        return super().read_chunk().decompressor is decompressors["bz2"]

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


def _layout(header: bytes) -> Layout | None:
    """Layout of the records of chunks; none if this header is not one."""
    text, at, names = "<", 0, list[bytes]()
    while at + 4 <= len(header):
        (size,) = _WORD(header, at)
        name, _, value = header[at + 4 : at + 4 + size].partition(b"=")
        kind = "II" if name in _TIMES else _KINDS.get(name, f"{len(value)}x")
        if struct.calcsize("<" + kind) != len(value):
            return None
        text += f"{4 + len(name) + 1}x{kind}"
        names += [name, name + b"_ns"] if name in _TIMES else [name] if name in _KINDS else []
        at += 4 + size
    wanted = [*_KINDS, *(each for name in _TIMES for each in (name, name + b"_ns"))]
    made = struct.Struct(text)
    if made.size != len(header) or sorted(names) != sorted(wanted):
        return None
    return made, [names.index(name) for name in wanted]
