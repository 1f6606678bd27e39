"""The reference beside the replays of a sequence."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from adaptune._system import manifest
from adaptune._system.files import write_text
from adaptune.reference.judge import Reference
from adaptune.runs.files import StoredReplayError
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory, read_tum, write_tum

CONTRADICTIONS = "contradictions.txt"
"""Written last: what scans say against a reference."""


def reference_folder(study: Study, name: str) -> Path:
    """Where the reference of a sequence's replays is: its name tells what it is made from."""
    in_real_time = study.config.online.model_dump(mode="json")["real_time"]
    odometries = [one.name for one in study.config.odometries.values()]
    about = manifest.plain([study.sequences.inputs(name), in_real_time, odometries])
    digest = manifest.digest(about)[: manifest.SHORT]
    return study.folder / "replays" / name / f"reference-{digest}"


def write_reference(
    folder: Path,
    reference: Trajectory | None,
    odometry: Trajectory,
    contradictions: Sequence[object] = (),
) -> None:
    """Write ``reference.tum``, at the stamps of a replay, and what scans say against it."""
    if reference is not None:
        T = reference.at(odometry.stamps)
        known = ~np.isnan(T[:, 0, 0])
        if not known.any():
            raise StoredReplayError(
                f"{folder.parent.name}: the reference does not overlap the scans in time; check "
                f"that both are of the same recording and clock"
            )
        write_tum(folder / "reference.tum", Trajectory(odometry.stamps[known], T[known]))
    write_text(folder / CONTRADICTIONS, "".join(f"{what}\n" for what in contradictions))


def read_contradictions(study: Study, name: str) -> list[str]:
    """What scans say against the reference of a sequence's replays.

    There is a StoredReplayError if that is not the one by which they were judged.
    """
    path = reference_folder(study, name) / CONTRADICTIONS
    if not path.exists():
        option = "" if study.model_path.exists() else " --untrained"
        raise StoredReplayError(
            f"{path.parents[1]}: was judged by another reference; run `adaptune online{option}` "
            f"with this study, which replays nothing for it"
        )
    return path.read_text(encoding="utf-8").splitlines()


def read_reference(study: Study, name: str) -> Reference:
    """Read the reference of a replayed sequence, if it has one; see `read_contradictions`."""
    read_contradictions(study, name)
    path = reference_folder(study, name) / "reference.tum"
    trajectory = read_tum(path) if path.exists() else None
    if trajectory is not None:
        # Frames in a gap, and across a jump, have no label in training, and get none here.
        known = study.sequences.open(name).reference()
        gap = trajectory.max_gap if known is None else known.max_gap
        # Nor have those of a segment that is left out, which is longer than this.
        steps = np.diff(trajectory.stamps) * 1e-9
        rare = 3.0 * float(np.median(steps)) if len(steps) else 0.0
        trajectory = replace(trajectory, max_gap=min(gap, max(1.9, rare)))
    return Reference.known(trajectory, study.config.sub_trajectory, study.sequences.estimate(name))
