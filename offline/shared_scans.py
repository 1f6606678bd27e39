"""Scans that are prepared once for all drives along a segment."""

import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from adaptune._system.machine import freeing_large_arrays
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.prepared import prepared_bytes
from adaptune.recording.scan import Recording, Scan, SequenceError
from offline.frames import Segment


@dataclass
class _Kept:
    """What a segment was prepared to in one way."""

    scans: dict[int, Any] = field(default_factory=dict)  # by number
    nbytes: int = 0
    seconds: float = 0.0  # of CPU time for `n_prepared` scans
    n_prepared: int = 0
    used: int = 0  # number of the last pass that asked for it,
    before: int = 0  # and of the one before


SharedScan = Callable[[OdometryInstance], Any]
"""Gives a scan as an instance takes it."""


class SharedScans:
    """The scans of segments, each prepared once for all instances with the same preparation.

    Prepared scans that exceed `memory` bytes are read and prepared again on every pass, once for
    all that share it. What was asked for longest ago makes room for what is asked for more often.
    """

    def __init__(self, memory: float):
        self.nbytes = 0  # that the prepared scans take
        self._memory = memory
        self._kept: dict[tuple[Hashable, ...], _Kept] = {}
        self._n_passes = 0

    def along(self, segment: Segment, scans: Recording) -> Iterator[SharedScan]:
        """Pass along a segment of a recording; scans are read where they are asked for."""
        self._n_passes += 1
        numbered = enumerate(_scans_of(segment, scans))
        last: tuple[int, Any] = -1, None

        def read(i: int) -> Any:
            nonlocal last
            while last[0] < i:
                last = next(numbered)
            return last[1]

        for i in range(len(segment.stamps)):
            yield partial(self._prepared, segment.key, i, partial(read, i), {})

    def _prepared(
        self,
        key: tuple[Hashable, ...],
        i: int,
        read: Callable[[], Scan],
        fresh: dict[Hashable, Any],
        instance: OdometryInstance,
    ) -> Any:
        """Scan `i` as an instance takes it; `fresh` has what there is no room for."""
        preparation = instance.preparation
        kept = self._kept.setdefault((*key, preparation), _Kept())
        if kept.used < self._n_passes:
            kept.before, kept.used = kept.used, self._n_passes
        if i in kept.scans:
            return kept.scans[i]
        if preparation in fresh:
            return fresh[preparation]
        # Also those that a pass makes while it runs: a worker once grew to five times its share.
        with freeing_large_arrays():
            scan = read()
            begin = time.process_time()
            prepared = instance.prepare(scan)
            kept.seconds += time.process_time() - begin
        kept.n_prepared += 1
        if self._has_room(size := prepared_bytes(prepared), kept.before):
            kept.scans[i] = prepared
            kept.nbytes += size
            self.nbytes += size
        else:
            fresh[preparation] = prepared
        return prepared

    def milliseconds(self, segment: Segment, instance: OdometryInstance) -> float:
        """Mean CPU time that it took to prepare a scan of a segment for such an instance."""
        kept = self._kept.get((*segment.key, instance.preparation))
        return 1e3 * kept.seconds / kept.n_prepared if kept and kept.n_prepared else 0.0

    def _has_room(self, size: int, since: int) -> bool:
        """Whether so many bytes more are allowed; make room of what has no use since a pass.

        So segments that are driven by turns, and do not fit together, do not drive each other out.
        """
        if self.nbytes + size <= self._memory:
            return True
        for kept in sorted(self._kept.values(), key=lambda kept: kept.used):
            if self.nbytes + size <= self._memory or kept.used >= since:
                break
            self.nbytes -= kept.nbytes
            kept.scans, kept.nbytes = {}, 0
        return self.nbytes + size <= self._memory


def _scans_of(segment: Segment, scans: Recording) -> Iterator[Scan]:
    """Read the scans of a segment; a SequenceError if that fails, or they have changed."""
    again = "run the same command again"
    try:
        read = scans.since(int(segment.stamps[0]))
        for stamp in segment.stamps.tolist():
            scan = next((one for one in read if one.stamp >= stamp), None)
            if scan is None or scan.stamp != stamp:
                raise SequenceError(f"{scans.name}: has other scans than before; {again}")
            yield scan
    except OSError as error:
        raise SequenceError(f"{scans.name}: cannot be read ({error}); {again}") from error
