import os
import subprocess
import sys

import numpy as np
import pytest

from adaptune import processes
from adaptune.errors import AdaptuneError


@pytest.fixture
def allowed(monkeypatch):
    """Cores of this process, of which a test may have as many as it likes."""
    now = {2, 3, 5, 7}

    def keep(_, some):
        now.clear()
        now.update(some)

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(now), raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", keep, raising=False)
    return now


def test_a_process_is_kept_on_one_core_until_that_is_undone(allowed):
    unpin = processes.pin(6)
    assert allowed == {5}
    assert processes.available() == 1
    unpin()
    assert allowed == {2, 3, 5, 7}


def test_others_get_one_core_after_the_other(allowed):
    some = [processes.next_core() for _ in range(8)]
    assert some[:4] == some[4:]
    assert set(some) == allowed


def test_others_get_the_rest_only_where_this_process_is_alone(allowed):
    unpin = processes.pin(1, alone=True)
    assert {processes.next_core() for _ in range(4)} == {2, 3, 5, 7}
    unpin()
    unpin = processes.pin(1)
    assert {processes.next_core() for _ in range(4)} == allowed == {3}
    unpin()


def test_those_that_work_for_this_process_get_other_cores(allowed):
    assert [processes.other_core(i) for i in range(4)] == [3, 5, 7, 3]
    unpin = processes.pin(1, alone=True)
    assert processes.together() == 4
    assert [processes.other_core(i) for i in range(4)] == [2, 5, 7, 2]
    unpin()
    allowed.clear()
    allowed.add(7)
    assert [processes.other_core(i) for i in range(2)] == [7, 7]
    assert processes.together() == 1


def test_mapped_files_are_no_memory_of_the_process(tmp_path):
    path = tmp_path / "mapped"
    np.zeros(50_000_000, np.uint8).tofile(path)
    mapped = np.memmap(path, np.uint8, "r")
    before = processes.resident_megabytes()
    assert mapped.sum() == 0  # now all of it is there
    assert processes.resident_megabytes() < before + 20.0
    held = np.ones(50_000_000, np.uint8)
    assert processes.resident_megabytes() > before + 40.0
    del held
    processes.release_memory()
    assert processes.resident_megabytes() < before + 20.0


def test_processes_compute_and_say_what_went_wrong():
    with processes.processes(2) as pool:
        assert list(pool.map(divmod, (7, 9), (2, 4))) == [(3, 1), (2, 1)]
        with pytest.raises(ZeroDivisionError):
            list(pool.map(divmod, (7, 9), (0, 4)))


def test_a_process_that_is_killed_is_told():
    with pytest.raises(AdaptuneError, match="was the memory full"), processes.processes(1) as pool:
        pool.submit(os._exit, 1).result()


HOLES = """
import contextlib, sys
import numpy as np
from adaptune import processes as cores
before = cores.resident_megabytes()
np.ones(2**21)  # once it is free, the C library keeps arrays of this size
large, small = [], []
with cores.apart() if sys.argv[1] == "apart" else contextlib.nullcontext():
    if sys.argv[1] == "apart":
        with cores.apart():
            pass  # the outer block goes on
    for _ in range(50):
        large.append(np.ones(2**18))
        small.append(np.ones(2**10))
large.clear()
print(cores.resident_megabytes() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="no glibc")
def test_large_arrays_among_small_ones_leave_no_holes():
    def kept(what):
        """Megabytes that a process keeps of 105 that are free."""
        command = [sys.executable, "-c", HOLES, what]
        return float(subprocess.run(command, capture_output=True, check=True, text=True).stdout)

    assert kept("as ever") > 50.0
    assert kept("apart") < 10.0
