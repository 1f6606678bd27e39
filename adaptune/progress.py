"""How far a long task is."""

from typing import Protocol


class Progress(Protocol):
    """Takes note of how far a task is."""

    def __call__(self, text: str, done: float, of: int, remark: str = "", /) -> None:
        """Note what is done, how much of it, and how much there is; half a run is a fraction."""


def unseen(text: str, done: float, of: int, remark: str = "", /) -> None:
    """Take no note."""
