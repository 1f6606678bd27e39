import os
import subprocess
import sys

import numpy as np
import pytest

from adaptune._system import machine


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


def test_pins_nest(allowed):
    """As where a reference is estimated while replays have the machine alone."""
    with machine.pin(1, alone=True):
        for alone in (False, True):
            with machine.pin(2, alone=alone):
                assert allowed == {3}
                assert machine.shared_cores() == {2, 3, 5, 7}
        assert machine.shared_cores() == {2, 3, 5, 7}
        assert machine.available() == 4
        assert machine.other_core(0) == 2
    assert allowed == machine.shared_cores() == {2, 3, 5, 7}


GROUPS = {
    # What /proc/self/cgroup has; files of the groups; cores and bytes that are left.
    "container": ("0::/", {"cpu.max": "100000 100000", "memory.max": "2000"}, 1, 2000),
    "container that sees the name outside": (
        "0::/docker/1f",
        {"cpu.max": "150000 100000", "memory.max": "2000"},
        2,
        2000,
    ),
    "slice around a service": (
        "0::/user.slice/our.service",
        {"user.slice/cpu.max": "250000 100000", "user.slice/our.service/cpu.max": "max 100000"},
        3,
        None,
    ),
    "older groups": (
        "5:name=systemd:/a\n4:cpuacct,cpu:/a:b\n3:memory:/\n0::/",
        {
            "cpu/a:b/cpu.cfs_quota_us": "20000",
            "cpu/a:b/cpu.cfs_period_us": "100000",
            "memory/memory.limit_in_bytes": "3000",
        },
        1,
        3000,
    ),
    "no limit": (
        "4:cpu:/\n3:memory:/",
        {
            "cpu/cpu.cfs_quota_us": "-1",
            "cpu/cpu.cfs_period_us": "100000",
            "memory/memory.limit_in_bytes": "9223372036854771712",
        },
        4,
        None,
    ),
    "more than there is": ("0::/", {"cpu.max": "900000 100000", "memory.max": "max"}, 4, None),
    "no groups": (None, {}, 4, None),
}


@pytest.mark.usefixtures("allowed")
@pytest.mark.parametrize(("own", "files", "cores", "most"), GROUPS.values(), ids=GROUPS)
def test_what_a_container_may_use_counts(tmp_path, monkeypatch, own, files, cores, most):
    if own is not None:
        (tmp_path / "own").write_text(own + "\n")
    for name, content in files.items():
        path = tmp_path / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content + "\n")
    monkeypatch.setattr(machine, "_OWN_GROUPS", tmp_path / "own")
    monkeypatch.setattr(machine, "_GROUPS", tmp_path / "groups")
    whole = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert machine.available() == cores
    assert machine.spare_memory() == 0.25 * (most or whole)


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
from adaptune._system import machine
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
