from itertools import islice

import numpy as np

from adaptune.odometry.base import OdometryInstance
from adaptune.recording.scan import Scan
from offline.trial import SharedScans

N, SIZE = 5, 1000


class Preparer(OdometryInstance):
    """Prepares scans to arrays of `SIZE` bytes, and counts them."""

    def __init__(self, key):
        self.key, self.count = key, 0

    @property
    def preparation(self):
        return self.key

    def prepare(self, scan):
        self.count += 1
        return np.full(SIZE, scan.stamp, np.uint8)

    def start(self, *_):
        raise AssertionError


class Read:
    """Scans that count how often they are read."""

    count = 0

    def __iter__(self):
        for stamp in range(N):
            self.count += 1
            yield Scan(stamp, np.zeros((1, 3), np.float32))


def passes(shared, *instances):
    """What each instance gets on a pass."""
    return [[int(scan(one)[0]) for one in instances] for scan in islice(shared, N)]


def test_each_scan_is_prepared_once_for_all_that_are_alike():
    read = Read()
    shared = SharedScans(read, 1e6)
    one, alike, other = Preparer("a"), Preparer("a"), Preparer("b")
    assert passes(shared, one, alike, other) == [[i, i, i] for i in range(N)]
    assert (one.count, alike.count, other.count) == (N, 0, N)
    assert read.count == N
    # Nothing is read or prepared again.
    assert passes(shared, alike, other) == [[i, i] for i in range(N)]
    assert (one.count, other.count, read.count) == (N, N, N)
    assert shared.nbytes == 2 * N * SIZE


def test_what_memory_does_not_hold_is_read_again():
    read = Read()
    shared = SharedScans(read, 2.5 * SIZE)
    one = Preparer("a")
    assert passes(shared, one) == passes(shared, one) == [[i] for i in range(N)]
    assert shared.nbytes == 2 * SIZE
    assert one.count == N + (N - 2)
    assert read.count == 2 * N


def test_preparations_that_a_pass_does_not_use_make_room():
    shared = SharedScans(Read(), N * SIZE)
    one, other = Preparer("a"), Preparer("b")
    passes(shared, one)
    passes(shared, other)
    # The first scan found no room.
    assert (shared.n_kept(one), shared.n_kept(other)) == (0, N - 1)
    # Of two that are used, none makes room for the other.
    passes(shared, one, other)
    assert (shared.n_kept(one), shared.n_kept(other)) == (1, N - 1)
