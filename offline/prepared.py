"""Scans that are prepared once for all trials of a worker."""

import time
from collections.abc import Callable, Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any

from adaptune.cores import apart
from adaptune.odometry.base import OdometryInstance, prepared_bytes
from adaptune.sequence.scan import Scan


@dataclass
class _Kept:
    """What a sequence was prepared to in one way."""

    first: OdometryInstance  # prepares for all with the same preparation
    scans: dict[int, Any] = field(default_factory=dict)  # by number
    nbytes: int = 0
    seconds: float = 0.0  # of CPU time for `n_prepared` scans
    n_prepared: int = 0


class SharedScans:
    """The scans of a sequence, each prepared once for all instances with the same preparation.

    Iterating yields a `SharedScan` for every scan, and does not end.

    Prepared scans that exceed `memory` bytes are read and prepared again on every pass. Of several
    preparations, those that a pass does not use make room.

    """

    def __init__(self, scans: Iterable[Scan], memory: float):
        self._scans, self._memory = scans, memory
        self._kept: dict[Hashable, _Kept] = {}
        self._used: set[Hashable] = set()  # in the present pass

    @property
    def nbytes(self) -> int:
        """Bytes that the prepared scans take."""
        return sum(kept.nbytes for kept in self._kept.values())

    def __iter__(self) -> Iterator["SharedScan"]:
        self._used = set()
        reader = _Reader(self._scans)
        for i in count():
            yield SharedScan(self, i, partial(reader.read, i))

    def prepared(self, i: int, read: Callable[[], Scan], instance: OdometryInstance) -> Any:
        """Scan `i`, which `read` returns, as an instance takes it."""
        key = instance.preparation
        self._used.add(key)
        kept = self._kept.setdefault(key, _Kept(instance))
        if i in kept.scans:
            return kept.scans[i]
        # Also those that a pass makes while it runs: a worker once grew to five times its share.
        with apart():
            scan, begin = read(), time.process_time()
            prepared = kept.first.prepare(scan)
            kept.seconds += time.process_time() - begin
        kept.n_prepared += 1
        if self._has_room(size := prepared_bytes(prepared), i):
            kept.scans[i] = prepared
            kept.nbytes += size
        return prepared

    def n_kept(self, instance: OdometryInstance) -> int:
        """How many scans are kept as such an instance takes them."""
        kept = self._kept.get(instance.preparation)
        return 0 if kept is None else len(kept.scans)

    def milliseconds(self, instance: OdometryInstance) -> float:
        """Mean CPU time that it took to prepare a scan for such an instance."""
        kept = self._kept.get(instance.preparation)
        return 1e3 * kept.seconds / kept.n_prepared if kept and kept.n_prepared else 0.0

    def _has_room(self, size: int, i: int) -> bool:
        """Whether so many bytes more are allowed at scan `i`; where they are not, make room."""
        # Which preparations a pass uses is known after its first scan.
        for key in [key for key in self._kept if i and key not in self._used]:
            if self.nbytes + size <= self._memory:
                break
            self._kept[key].scans.clear()
            self._kept[key].nbytes = 0
        return self.nbytes + size <= self._memory


class SharedScan:
    """A scan of `SharedScans`; `by` gives it as an instance takes it."""

    def __init__(self, scans: SharedScans, i: int, read: Callable[[], Scan]):
        self._scans, self._i, self._read = scans, i, read

    def by(self, instance: OdometryInstance) -> Any:
        """The scan as an instance takes it."""
        return self._scans.prepared(self._i, self._read, instance)


class _Reader:
    """Reads scans in order, and only if it is asked for one."""

    def __init__(self, scans: Iterable[Scan]):
        self._scans = scans
        self._iterator: Iterator[Scan] | None = None
        self._at = -1

    def read(self, i: int) -> Scan:
        """Scan `i`, which is no earlier than the one before."""
        if self._iterator is None:
            self._iterator = iter(self._scans)
        while self._at < i:
            self._scan = next(self._iterator)
            self._at += 1
        return self._scan
