"""The reference beside the replays of a sequence, and what it was made from."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.files import write_text
from adaptune.trajectory import Trajectory, write_tum
from online.stored_replays import StoredReplayError


class StoredReferenceError(AdaptuneError):
    """A reference that does not go with a replay."""


def is_reference_of(folder: Path, about: dict[str, Any]) -> bool:
    """Whether the reference in a folder was made from just this."""
    try:
        made: Any = json.loads((folder / "reference.json").read_text(encoding="utf-8"))
        of, known = made["about"], made["known"]
    except (OSError, ValueError, TypeError, KeyError):
        return False
    return bool(of == about and known == (folder / "reference.tum").exists())


def check_reference(folder: Path, about: dict[str, Any], option: str = "") -> None:
    """Refuse a reference that was made from something else.

    Parameters
    ----------
    folder
        Of the sequence's replays.
    about
        What the reference should be made from.
    option
        Of the command that makes it again.

    Raises
    ------
    StoredReplayError
    """
    if not is_reference_of(folder, about):
        raise StoredReplayError(
            f"{folder}: was judged by another reference; run `adaptune online{option}` with this "
            f"study, which replays nothing for it"
        )


def write_reference(
    folder: Path, reference: Trajectory | None, odometry: Trajectory, about: dict[str, Any]
) -> None:
    """Write ``reference.tum``, at the scans' stamps; remove it if there is none.

    Parameters
    ----------
    folder
        Of the sequence's replays.
    reference
        Of the sequence.
    odometry
        A replay, which has the stamps.
    about
        What the reference is made from, noted in ``reference.json``.
    """
    path = folder / "reference.tum"
    if reference is None:
        path.unlink(missing_ok=True)
    else:
        T = reference.at(odometry.stamps)
        known = ~np.isnan(T[:, 0, 0])
        if not known.any():
            raise StoredReferenceError(
                f"{folder.name}: the reference does not overlap the scans in time; check that both "
                f"are of the same recording and clock"
            )
        write_tum(path, Trajectory(odometry.stamps[known], T[known]))
    note = {"about": about, "known": reference is not None}
    write_text(folder / "reference.json", json.dumps(note, indent=1) + "\n")
