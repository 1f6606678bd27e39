import os
import subprocess
import sys

import pytest
from wicked import gone, wait_until_gone

from adaptune._system import forking
from adaptune.errors import AdaptuneError


def test_a_process_that_is_killed_is_told():
    with pytest.raises(AdaptuneError, match="was the memory full"), forking.processes(1) as pool:
        pool.submit(os._exit, 1).result()


PINNED = """
import os
from adaptune._system.forking import processes
from adaptune._system.machine import pin

if __name__ == "__main__":
    cores = os.sched_getaffinity(0)
    with pin(0, alone=True), processes(1) as pool:  # this starts the server of all later ones
        assert pool.submit(os.sched_getaffinity, 0).result() == cores
        assert len(os.sched_getaffinity(0)) == 1
"""


def test_processes_are_not_pinned_with_the_one_that_they_work_for(tmp_path):
    (tmp_path / "pinned.py").write_text(PINNED)
    subprocess.run([sys.executable, "pinned.py"], cwd=tmp_path, check=True)


OWNER = """
import os, sys, time
from adaptune._system import forking
with forking.processes(1) as pool:
    print(pool.submit(os.getpid).result(), flush=True)
    pool.submit(time.sleep, 600).result()
"""


def test_a_process_ends_with_the_one_that_it_computes_for():
    owner = subprocess.Popen(
        [sys.executable, "-c", OWNER],
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        text=True,
    )
    with owner:
        worker = owner.stdout.readline().strip()
        assert not gone(worker)
        owner.kill()
    wait_until_gone([worker])


ODD = """
import os, sys
from pathlib import Path
from adaptune._system.forking import processes

def seen():
    import offline, random
    return [os.getcwd(), offline.__file__, random.__file__]

if __name__ == "__main__":
    with processes(1, ["offline", "random", "statistics"]) as pool:
        import offline, random
        assert pool.submit(seen).result() == [os.getcwd(), offline.__file__, random.__file__]
    print("well")
"""


def test_processes_begin_whatever_the_folder_holds_and_however_long_its_name_is(tmp_path):
    (tmp_path / "odd.py").write_text(ODD)
    here = tmp_path / ("x" * 100)
    here.mkdir()
    # Modules of Python's, of multiprocessing's, and of adaptune's.
    for name in ("random", "statistics", "selectors", "queue", "offline"):
        (here / f"{name}.py").write_text("import os; os.abort()")
    done = subprocess.run(
        [sys.executable, "-P", tmp_path / "odd.py"],
        cwd=here,
        env=os.environ | {"TMPDIR": str(here)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout, done.stderr) == ("well\n", "")
    assert not list(here.glob("pymp-*"))


POOL = """
import multiprocessing as mp
from adaptune import errors
from adaptune._system import forking
def work(_):
    try:
        forking.fork_server()
    except errors.AdaptuneError as error:
        return str(error)
if __name__ == "__main__":
    with mp.Pool(1) as pool:
        print(*pool.map(work, [0]))
"""


def test_a_worker_of_a_pool_is_told_that_it_may_start_no_processes(tmp_path):
    (tmp_path / "pooled.py").write_text(POOL)
    command = [sys.executable, tmp_path / "pooled.py"]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "multiprocessing.Pool may start no others: call adaptune in the main process" in said
