"""A pool without processes: it runs each task when its outcome is asked for."""

from collections.abc import Collection, Sequence
from typing import Any, Self

from offline.trial import TrialSetup
from offline.workers import Outcome, Sequences, Task, TaskProgress, attempt


class InProcess:
    """Stands in for `offline.workers.Workers`: as many workers, one after another."""

    def __init__(self, setup: TrialSetup, n: int, memory: float):
        self.setup, self.n, self.memory = setup, n, memory
        self._sequences = [Sequences(setup, memory / n) for _ in range(n)]
        self._tasks: dict[int, Task] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def workers(self) -> Collection[int]:
        return range(self.n)

    def start(self, worker: int, task: Task) -> None:
        self._tasks[worker] = task

    def wait(self) -> Sequence[tuple[int, Outcome | TaskProgress]]:
        worker = next(iter(self._tasks))
        said: list[tuple[int, Any]] = []
        outcome = attempt(
            self._sequences[worker],
            self._tasks.pop(worker),
            lambda *now: said.append((worker, TaskProgress(*now))),
        )
        return [*said, (worker, outcome)]
