import threading
from itertools import islice

import pytest

from adaptune.recording.scan import read_ahead


def test_scans_come_in_order_and_errors_where_they_are_read():
    def scans():
        yield from range(5)
        raise ValueError("damaged")

    read = read_ahead(scans(), 2)
    assert list(islice(read, 5)) == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="damaged"):
        next(read)
    assert list(read_ahead([1, 2, 3], 8)) == [1, 2, 3]


def test_what_is_not_read_to_its_end_is_closed_in_the_thread_that_opened_it():
    threads, closed = [], threading.Event()

    def scans():
        threads.append(threading.get_ident())
        try:
            yield from range(100)
        finally:
            threads.append(threading.get_ident())
            closed.set()

    read = read_ahead(scans(), 2)
    assert next(read) == 0
    read.close()
    assert closed.wait(60.0)
    assert threads[0] == threads[1] != threading.get_ident()
