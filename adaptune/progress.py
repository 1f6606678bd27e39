"""How far a long task is."""

from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

T = TypeVar("T")


class Progress(Protocol):
    """Takes note of how far a task is."""

    def __call__(self, text: str, done: float, of: int, remark: str = "", /) -> None:
        """Note what is done, how much of it, and how much there is; half a run is a fraction."""


def unseen(text: str, done: float, of: int, remark: str = "", /) -> None:
    """Take no note."""


def watched(scans: Iterable[T], n: int, what: str, progress: Progress) -> Iterator[T]:
    """The same, and note how many of `n` are done."""
    done = 0
    for done, scan in enumerate(scans, start=1):
        yield scan
        progress(what, min(done, n), n)
    progress(what, done, done)
