"""How far a long task is."""

from typing import Protocol


class Progress(Protocol):
    """Takes note of how far a task is."""

    def __call__(self, text: str, done: float, of: int, remark: str = "", /) -> None:
        """Note what is done, how much of it, and how much there is; half a run is a fraction."""


def unseen(text: str, done: float, of: int, remark: str = "", /) -> None:
    """Take no note."""


def part(progress: Progress, name: str) -> Progress:
    """Note a part of a task: what is done gets a name before it."""

    def noted(text: str, done: float, of: int, remark: str = "", /) -> None:
        progress(f"{name}, {text}", done, of, remark)

    return noted
