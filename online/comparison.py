"""The comparison of baseline, fixed and adaptive on the replayed sequences."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import report
from adaptune.geometry import invert
from adaptune.model import ErrorModel
from adaptune.study.inputs import check_model
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory
from online.modes import ReplaySetup
from online.replay_picture import Track, draw_replays
from online.run_replays import shared_identity
from online.statistics import ComparisonRow, Reference, compare_modes, pooled
from online.stored_reference import is_reference_of
from online.stored_replays import ReplaySummary, StoredReplay, StoredReplayError


def compare(study: Study) -> list[ComparisonRow]:
    """Compare the replays that were made, and write tables and pictures.

    Parameters
    ----------
    study
        The study; its folder receives ``comparison.csv``, ``comparison.json`` and a picture (PNG
        and SVG) for every sequence in ``comparison``.

    Returns
    -------
    list of ComparisonRow
        A row for every sequence and mode, and a row for every mode over all sequences.

    Raises
    ------
    StoredReplayError
        If a replay is missing, damaged, or of another recording or configuration.
    """
    setup = ReplaySetup.of(study)
    _check_replays(study, setup)
    logarithmic = [
        name
        for name, parameter in setup.odometry.space.parameters.items()
        if getattr(parameter, "log", False)
    ]
    rows: list[ComparisonRow] = []
    for name in study.config.test:
        folder = study.folder / "replays" / name
        replays = {mode: StoredReplay.read(folder / mode) for mode in setup.modes}
        reference = Reference.read(folder, study.config.sub_trajectory)
        rows += compare_modes(name, replays, reference)
        draw_replays(
            study.folder / "comparison" / f"{name}.png",
            f"{study.name}: {name}",
            study.config.sub_trajectory,
            {mode: _track(replay, reference) for mode, replay in replays.items()},
            None if reference.trajectory is None else _seen_from(reference.trajectory),
            logarithmic,
        )
    if len({row.sequence for row in rows if row.rte is not None}) > 1:
        rows += pooled(rows)
    report.write_rows(study.folder / "comparison", "comparison", [row.columns() for row in rows])
    return rows


def remark(rows: Sequence[ComparisonRow]) -> str | None:
    """In words where the baseline has less error than the fixed set."""
    of_baseline = [row for row in rows if row.mode == "baseline" and row.vs_fixed is not None]
    # The last row is that over all sequences.
    if not of_baseline or not (ratio := of_baseline[-1].vs_fixed) or ratio >= 1.0:
        return None
    return (
        f"The baseline is better than the fixed set here: on {of_baseline[-1].sequence} it has "
        f"{ratio:.2f} times its error."
    )


def _track(replay: StoredReplay, reference: Reference) -> Track:
    stamps, known = replay.trajectory.stamps, reference.trajectory
    # The odometry's own frame begins elsewhere: both are drawn from the first common pose.
    start = 0 if known is None else int(np.argmax(np.isin(stamps, known.stamps)))
    return Track(
        (stamps - stamps[0]) * 1e-9,
        _seen_from(replay.trajectory, start),
        reference.errors(replay.trajectory),
        replay.restarted,
        np.asarray((replay.choice_stamps - stamps[0]) * 1e-9),
        replay.choices,
        replay.weights,
    )


def _seen_from(trajectory: Trajectory, start: int = 0) -> NDArray[np.float64]:
    """Positions in the plane of the sensor at a pose: x forward, y to the left."""
    T = trajectory.T_world_sensor
    return np.asarray((invert(T[start]) @ T)[:, :2, 3])


def _check_replays(study: Study, setup: ReplaySetup) -> None:
    """Refuse replays that are missing, or of another recording, model or configuration."""
    made = {
        (name, mode): ReplaySummary.read(study.folder / "replays" / name / mode)
        for name in study.config.test
        for mode in setup.modes
    }
    path, model = _model_of(study, made.values())
    for (name, mode), summary in made.items():
        now, about = shared_identity(study, name), summary.about.model_dump()
        if model is not None:
            whole = setup.identity(mode, model, model.digest)
            now |= {key: whole[key] for key in ("model", "parameters")}
            if not _is_automatic(study, whole["switching"], about["switching"]):
                now["switching"] = whole["switching"]
        if differing := [key for key, value in now.items() if about[key] != value]:
            own = path == study.model_path.resolve()
            raise StoredReplayError(
                f"{study.folder / 'replays' / name / mode}: was replayed with another "
                f"{', '.join(differing)}; run `adaptune online{'' if own else f' --model {path}'}` "
                f"with this study"
            )
    for name in study.config.test:
        if not is_reference_of(study.folder / "replays" / name, study.sequences.reference(name)):
            raise StoredReplayError(
                f"{study.folder / 'replays' / name}: was judged by another reference; run "
                f"`adaptune online` with this study, which replays nothing for it"
            )


def _model_of(study: Study, summaries: Collection[ReplaySummary]) -> tuple[Path, ErrorModel | None]:
    """File of the model that all replays are of, and the model if the file is still there."""
    own = study.model_path.resolve()
    files = {s.about.model: s.model_file for s in summaries if s.about.model is not None}
    if len(files) > 1:
        raise StoredReplayError(
            f"{study.folder / 'replays'}: holds replays with different models "
            f"({' and '.join(sorted(set(files.values())))}); run `adaptune online` again"
        )
    path = Path(next(iter(files.values()), own))
    if not path.exists():
        return path, None
    model = ErrorModel.load(path)
    if path == own:
        check_model(study, model.sequences, model.provenance)
    return path, model


def _is_automatic(study: Study, now: Any, made: Any) -> bool:
    """Whether a replay differs only in the mechanism that this machine would choose."""
    if study.config.online.switching.mechanism != "auto" or None in (now, made):
        return False
    return bool(now["mechanism"] != made["mechanism"])
