"""ROS 1 bags that are opened by the index at their end alone."""

from collections import Counter, defaultdict
from collections.abc import Collection, Generator

from rosbags.interfaces import Connection
from rosbags.rosbag1 import Reader
from rosbags.rosbag1.reader import Chunk, IndexData, decompressors

_NOTHING = Chunk(0, 0, bytes)


class IndexReader(Reader):
    """Looks a chunk up only when messages of its time are asked for.

    rosbags visits every chunk when it opens a bag, which takes seconds for 100,000 of them. What
    they hold is also listed at the end of the file.
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
