"""The reference beside the replays of a sequence."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from adaptune import manifest
from adaptune.files import write_text
from adaptune.reference.judge import Reference
from adaptune.strict import ConfigurationError
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory, read_tum, write_tum
from online.record import StoredReplayError

_CONTRADICTIONS = "contradictions.txt"
_REFERENCE_INPUTS = f"reference.{manifest.FILE}"


def is_reference_of(folder: Path, about: manifest.Inputs) -> bool:
    """Whether the reference in a folder was made from just this."""
    known = (folder / "reference.tum").exists()
    try:
        made = manifest.recorded(folder / _REFERENCE_INPUTS)
    except ConfigurationError:
        return False
    return made is not None and not manifest.changes(made, {**about, "known": known})


def check_reference(folder: Path, about: manifest.Inputs) -> None:
    """Refuse a reference that was made from something else, by a StoredReplayError."""
    if not is_reference_of(folder, about):
        option = "" if (folder / "fixed").exists() else " --untrained"
        raise StoredReplayError(
            f"{folder}: was judged by another reference; run `adaptune online{option}` with this "
            f"study, which replays nothing for it"
        )


def write_reference(
    folder: Path,
    reference: Trajectory | None,
    odometry: Trajectory,
    about: manifest.Inputs,
    contradictions: Sequence[object] = (),
) -> None:
    """Write ``reference.tum``, at the stamps of a replay; remove it if there is none.

    `about` is what the reference is made from, see `adaptune.manifest`; `contradictions` is what
    scans say against it.
    """
    path = folder / "reference.tum"
    if reference is None:
        path.unlink(missing_ok=True)
    else:
        T = reference.at(odometry.stamps)
        known = ~np.isnan(T[:, 0, 0])
        if not known.any():
            raise StoredReplayError(
                f"{folder.name}: the reference does not overlap the scans in time; check that both "
                f"are of the same recording and clock"
            )
        write_tum(path, Trajectory(odometry.stamps[known], T[known]))
    write_text(folder / _CONTRADICTIONS, "".join(f"{what}\n" for what in contradictions))
    manifest.record(folder / _REFERENCE_INPUTS, {**about, "known": reference is not None})


def read_contradictions(folder: Path) -> list[str]:
    """What scans say against the reference of a sequence's replays."""
    path = folder / _CONTRADICTIONS
    return path.read_text(encoding="utf-8").splitlines() if path.exists() else []


def read_reference(study: Study, name: str) -> Reference:
    """Read the reference of a replayed sequence, if it has one, from beside its replays."""
    path = study.folder / "replays" / name / "reference.tum"
    trajectory = read_tum(path) if path.exists() else None
    if trajectory is not None:
        # Frames in a gap, and across a jump, have no label in training, and get none here.
        known = study.sequences.open(name).reference()
        gap = trajectory.max_gap if known is None else known.max_gap
        # Nor have those of a stretch that is left out, which is longer than this.
        steps = np.diff(trajectory.stamps) * 1e-9
        rare = 3.0 * float(np.median(steps)) if len(steps) else 0.0
        trajectory = replace(trajectory, max_gap=min(gap, max(1.9, rare)))
    return Reference.known(trajectory, study.config.sub_trajectory, study.sequences.estimate(name))
