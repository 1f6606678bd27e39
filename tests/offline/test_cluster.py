import json
import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from threading import Thread

import drives
import faulty
import kills
import pytest
from made_drives import Tasks, task_of
from setups import setup_of

from adaptune.odometry.remote import Limits
from adaptune.simulation import Course
from adaptune.study.sequences import StudySequences
from offline import workers as cluster
from offline.config import load_study
from offline.train import train
from offline.workers import Cluster, ClusterError, run

pytestmark = pytest.mark.services

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory):
    """Address of a scheduler, a function that starts a worker, and the workers."""
    cwd = tmp_path_factory.mktemp("dask")
    file = cwd / "scheduler.json"
    silent = {
        "cwd": cwd,
        "stderr": subprocess.DEVNULL,
        "env": os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    }
    code = (
        "import asyncio, sys; from distributed import Scheduler\n"
        "async def main():\n"
        "    async with Scheduler(host='127.0.0.1', port=0, dashboard=False) as s:\n"
        "        open(sys.argv[1], 'w').write(s.address)\n"
        "        await s.finished()\n"
        "asyncio.run(main())"
    )
    processes = [subprocess.Popen([sys.executable, "-c", code, str(file)], **silent)]
    while not (file.exists() and file.read_text()):
        time.sleep(0.05)
    address = file.read_text()

    def worker(version="", slow=0.0):
        """Of another version; or one whose disk takes so many seconds to open a recording."""
        code = (
            "import asyncio, io, sys, time; from distributed import Worker\n"
            "if sys.argv[2]:\n"
            "    import importlib.metadata\n"
            "    importlib.metadata.version = lambda name: sys.argv[2]\n"
            "fast, slow = io.open, float(sys.argv[3])\n"
            "def opened(file, *args, **options):\n"
            "    if slow and str(file).endswith('.bag'):\n"
            "        fast('slept', 'a').write('once\\n')\n"
            "        time.sleep(slow)\n"
            "    return fast(file, *args, **options)\n"
            "io.open = opened if slow else fast\n"
            "async def main():\n"
            "    async with Worker(sys.argv[1], nthreads=1, dashboard=False) as w:\n"
            "        await w.finished()\n"
            "asyncio.run(main())"
        )
        made = subprocess.Popen([sys.executable, "-c", code, address, version, str(slow)], **silent)
        processes.append(made)
        return made

    worker.folder = cwd
    yield address, worker
    for process in processes:
        process.kill()
        process.wait()


@pytest.fixture(scope="module")
def workers(scheduler):
    address, worker = scheduler
    made = [worker() for _ in range(3)]
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(3)
    return made


@pytest.fixture(scope="module")
def local(trained_folder):
    return kills.contents(trained_folder)


def cluster_of(study, address):
    return Cluster(setup_of(study), study.training, address)


def test_a_cluster_without_workers_is_told(study_file, tmp_path, scheduler, monkeypatch):
    monkeypatch.setattr(cluster, "_TIMEOUT", 2.0)
    study = load_study(study_file, [], tmp_path / "study")
    with pytest.raises(ClusterError, match="has no workers; start some with `dask worker tcp"):
        cluster_of(study, scheduler[0])
    with pytest.raises(ClusterError, match="cannot be reached"):
        cluster_of(study, "tcp://127.0.0.1:1")
    with pytest.raises(ClusterError, match="cannot be reached"):
        cluster_of(study, "nonsense://x")


@pytest.mark.parametrize("greeting", [b"", b"SSH-2.0-OpenSSH_9.2\r\n"])
def test_what_answers_and_is_no_scheduler_is_told(study_file, tmp_path, monkeypatch, greeting):
    """As the dashboard, which waits for a question, and other servers."""
    monkeypatch.setattr(cluster, "_TIMEOUT", 0.5)
    study = load_study(study_file, [], tmp_path / "study")

    def greet():
        with suppress(OSError):
            while True:
                taken.append(server.accept()[0])
                taken[-1].sendall(greeting)

    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = []
        listening = Thread(target=greet, daemon=True)
        listening.start()
        with pytest.raises(
            ClusterError, match=r"something else answers.*its dashboard has another"
        ):
            cluster_of(study, f"tcp://127.0.0.1:{server.getsockname()[1]}")
        server.shutdown(socket.SHUT_RDWR)
        listening.join()
    for connection in taken:
        connection.close()


def test_a_worker_is_no_scheduler(study_file, tmp_path, scheduler, workers):
    assert len(workers) == 3
    study = load_study(study_file, [], tmp_path / "study")
    with distributed.Client(scheduler[0], set_as_default=False) as client:
        worker = next(iter(client.scheduler_info()["workers"]))
    with pytest.raises(ClusterError, match="Worker answers there, and no scheduler; name the add"):
        cluster_of(study, worker)


def test_the_cluster_gives_the_local_trials(study_file, tmp_path, scheduler, workers, local):
    assert len(workers) == 3
    study = load_study(study_file, [], tmp_path / "study")
    train(study, cluster=scheduler[0])
    assert kills.contents(study.folder) == local


@pytest.mark.usefixtures("workers")
@pytest.mark.parametrize("what", ["has another content than", "is missing"])
def test_a_worker_without_the_recording_is_told(study_file, tmp_path, scheduler, monkeypatch, what):
    own = cluster.contents

    def elsewhere(sequences, name):
        found = own(sequences, name)
        return dict.fromkeys(found, "another") if what != "is missing" else {lost: ""} | found

    # The workers, which are not patched, find theirs.
    monkeypatch.setattr(cluster, "contents", elsewhere)
    study = load_study(study_file, [], tmp_path / "study")
    lost = study_file.parent / "lost.bag"
    with pytest.raises(ClusterError, match=rf"worker tcp://.*: {study_file.parent}.*bag: {what}"):
        train(study, cluster=scheduler[0])


def test_a_class_of_the_user_that_hangs_is_ended(study_file, tmp_path, scheduler, workers):
    assert len(workers) == 3
    overrides = ["odometry.name=faulty:Clean", "odometry.parameters=", "odometry.settings="]
    study = load_study(study_file, overrides, tmp_path / "study")
    hangs = replace(
        study.odometry,
        settings=faulty.Settings(fault="hang", at=drives.FIRST_STAMP + 12 * 10**8),
        limits=Limits(seconds=1.0),
        user_code=True,
    )
    setup = setup_of(study, hangs)
    tasks = Tasks(task_of(setup, "one", {0: {"x": 0.5}}))
    with Cluster(setup, ["one"], scheduler[0]) as pool:
        ((_, result),) = run(pool, tasks)
    assert "a scan took longer than" in result[0][0].faults[0]


def test_a_worker_whose_disk_is_slow_takes_longer(
    study_file, tmp_path, scheduler, workers, local, monkeypatch
):
    monkeypatch.setattr(cluster, "_TIMEOUT", 2.0)
    address, worker = scheduler
    slow = worker(slow=3.0)
    with distributed.Client(address, set_as_default=False) as client:
        client.wait_for_workers(len(workers) + 1)
    study = load_study(study_file, [], tmp_path / "study")
    try:
        train(study, cluster=address)
    finally:
        slow.kill()
    assert kills.contents(study.folder) == local
    assert (worker.folder / "slept").exists()


def test_a_killed_worker_s_trials_run_elsewhere(
    study_file, tmp_path, scheduler, workers, local, monkeypatch
):
    monkeypatch.setattr(cluster, "_TIMEOUT", 2.0)
    study = load_study(study_file, [], tmp_path / "study")
    pids, read, lost = {}, Cluster._outcome, []

    def kill_first(self, worker, future, hosts):
        # A worker that dies with a result that nobody has read.
        if not lost and future.status == "finished":
            pids.update(self._client.run(os.getpid))
            lost.append(worker)
            os.kill(pids[worker], signal.SIGKILL)
        return read(self, worker, future, hosts)

    def kill_at_work(_what, done, *_):
        for worker, pid in pids.items():
            if done and len(lost) == 1 and worker not in lost:
                lost.append(worker)
                os.kill(pid, signal.SIGKILL)

    monkeypatch.setattr(Cluster, "_outcome", kill_first)
    train(study, kill_at_work, cluster=scheduler[0])
    assert kills.contents(study.folder) == local
    assert len(lost) == 2
    assert sum(process.poll() is None for process in workers) == 1


def test_workers_of_another_version_are_refused(study_file, tmp_path, scheduler):
    address, worker = scheduler
    other = worker("0.0.7")
    with distributed.Client(address, set_as_default=False) as client:
        n = len(client.scheduler_info(n_workers=-1)["workers"])
        client.wait_for_workers(n + 1)
    study = load_study(study_file, [], tmp_path / "study")
    with pytest.raises(ClusterError, match=r"has adaptune 0\.0\.7, and this is"):
        train(study, cluster=address)
    assert not list((study.folder / "trials").glob("*/*"))
    other.kill()


def test_a_worker_says_that_its_recording_is_of_another_course(tmp_path):
    sequences = StudySequences({}, {"c": Course(scenes=("corridor",), length=10)}, tmp_path)
    bag = sequences.recording("c")
    bag.parent.mkdir()
    bag.write_bytes(b"")
    of_another = Course(scenes=("corridor",), length=10, seed=9).recorded()
    bag.with_suffix(".json").write_text(json.dumps(of_another))
    with pytest.raises(ClusterError, match=r"c\.bag is of another course: seed is 9 there, and 0"):
        cluster.check_files(sequences, "c", {bag: "its content"})
    bag.unlink()
    with pytest.raises(ClusterError, match=r"c\.bag: is missing; copy it there"):
        cluster.check_files(sequences, "c", {bag: "its content"})
