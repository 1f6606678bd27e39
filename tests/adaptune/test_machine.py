import os
import subprocess
import sys

import numpy as np
import pytest

from adaptune import machine


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
    with machine.pin(6):
        assert allowed == {5}
        assert machine.available() == 1
    assert allowed == {2, 3, 5, 7}


def test_others_get_the_rest_only_where_this_process_is_alone(allowed):
    with machine.pin(1, alone=True):
        assert {machine.next_core() for _ in range(4)} == {2, 3, 5, 7}
    with machine.pin(1):
        assert {machine.next_core() for _ in range(4)} == allowed == {3}


def test_those_that_work_for_this_process_get_other_cores(allowed):
    assert [machine.other_core(i) for i in range(4)] == [3, 5, 7, 3]
    with machine.pin(1, alone=True):
        assert machine.shared_cores() == {2, 3, 5, 7}
        assert [machine.other_core(i) for i in range(4)] == [2, 5, 7, 2]
    allowed.clear()
    allowed.add(7)
    assert [machine.other_core(i) for i in range(2)] == [7, 7]
    assert machine.shared_cores() == {7}


def test_mapped_files_are_no_memory_of_the_process(tmp_path):
    path = tmp_path / "mapped"
    np.zeros(50_000_000, np.uint8).tofile(path)
    mapped = np.memmap(path, np.uint8, "r")
    before = machine.resident_megabytes()
    assert mapped.sum() == 0  # now all of it is there
    assert machine.resident_megabytes() < before + 20.0
    held = np.ones(50_000_000, np.uint8)
    assert machine.resident_megabytes() > before + 40.0
    del held
    machine.release_memory()
    assert machine.resident_megabytes() < before + 20.0


HOLES = """
import contextlib, sys
import numpy as np
from adaptune import machine
before = machine.resident_megabytes()
np.ones(2**21)  # once it is free, the C library keeps arrays of this size
large, small = [], []
with machine.freeing_large_arrays() if sys.argv[1] == "freed" else contextlib.nullcontext():
    if sys.argv[1] == "freed":
        with machine.freeing_large_arrays():
            pass  # the outer block goes on
    for _ in range(50):
        large.append(np.ones(2**18))
        small.append(np.ones(2**10))
large.clear()
print(machine.resident_megabytes() - before)
"""


def test_large_arrays_among_small_ones_leave_no_holes():
    def kept(what):
        """Megabytes that a process keeps of 105 that are free."""
        command = [sys.executable, "-c", HOLES, what]
        return float(subprocess.run(command, capture_output=True, check=True, text=True).stdout)

    assert kept("as ever") > 50.0
    assert kept("freed") < 10.0
