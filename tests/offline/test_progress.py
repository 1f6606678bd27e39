import errno
from importlib import import_module
from types import SimpleNamespace

import pytest
from made_drives import Tasks

from offline import workers
from offline.config import load_study
from offline.train import train
from offline.workers import Death, Task, TaskProgress, Workers, now_and_then, run

TASK = Task("one", sets={0: {}, 1: {}})


class TwoWords:
    """A pool of one worker that tells how far it is before it is done."""

    def __init__(self, *said):
        self.said = list(said)

    def workers(self):
        return [0]

    def start(self, worker, task):
        pass

    def wait(self):
        return [(0, self.said.pop(0) if self.said else {})]


def test_what_a_dead_worker_had_done_does_not_count():
    half, work = TaskProgress("running", 8, 10), Tasks(TASK)
    list(run(TwoWords(half, Death("it was killed"), half), work))
    assert [progress.done for progress in work.noted] == [8, 0, 8]


class Elsewhere:
    """A setup whose module a worker does not find."""

    def __reduce__(self):
        return import_module, ("no_module_of_the_worker_s",)


def test_a_worker_that_cannot_import_tells_why():
    with Workers(Elsewhere(), 1, 1e9) as pool, pytest.raises(workers.WorkerError) as caught:
        list(run(pool, Tasks(TASK)))
    assert "No module named 'no_module_of_the_worker_s'" in str(caught.value)


def test_workers_report_now_and_then_and_at_the_end(monkeypatch):
    times = iter([0.0, *(0.1 * i for i in range(1, 21))])
    monkeypatch.setattr(workers.time, "monotonic", lambda: next(times))
    told = []
    report = now_and_then(told.append)
    for i in range(1, 21):
        report("running", i, 20)
    assert [progress.done for progress in told] == [6, 12, 18, 20]


@pytest.mark.parametrize("workers", [1, 2])
def test_offline_shows_scans_and_runs(study_file, tmp_path, workers):
    calls = []
    overrides = ["offline.trials=4", f"offline.workers={workers}"]
    train(load_study(study_file, overrides, tmp_path), lambda *call: calls.append(call))
    for name in ("one", "two"):
        assert (f"reading {name}", 40, 40, "") in calls
    # Two sequences, which are driven whole by all; the baseline comes first.
    assert not [call for call in calls if call[0] == "whole drives"]
    for what, total in (("baseline", 2), ("runs", 8)):
        done = [call[1] for call in calls if call[0] == what]
        assert done[-1] == total
        if workers == 1:
            assert done == sorted(done)
        assert {call[2] for call in calls if call[0] == what} == {total}


@pytest.mark.parametrize(("cause", "memory"), [("SIGKILL", True), ("ended with code 1", False)])
def test_only_a_worker_that_was_killed_may_have_lacked_memory(cause, memory):
    pool = TwoWords(*[Death(cause)] * workers.MOST_DEATHS)
    with pytest.raises(workers.WorkerError) as caught:
        list(run(pool, Tasks(TASK)))
    assert ("out of memory" in str(caught.value)) == memory


@pytest.mark.parametrize(
    ("error", "words"),
    [(MemoryError(), "out of memory"), (OSError(errno.ENOSPC, "full"), "the disk is full")],
)
def test_what_the_machine_lacks_is_told_in_a_sentence(error, words):
    def lacking(*_):
        raise error

    failure = workers.attempt(SimpleNamespace(run=lacking), TASK)
    assert str(failure).startswith(f"one, trials 0, 1: {words}; ")
