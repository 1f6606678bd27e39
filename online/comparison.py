"""The comparison of baseline, fixed and adaptive on the replayed sequences."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from adaptune import report
from adaptune.drawing import LINES
from adaptune.geometry import invert
from adaptune.model import ErrorModel
from adaptune.study.driven import RIVALS, named
from adaptune.study.inputs import check_model
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory
from online.modes import BASELINE, UNTRAINED, WITHOUT_MODEL, ReplaySetup, sequences_without_model
from online.replay_picture import Track, draw_replays
from online.run_replays import shared_identity
from online.statistics import (
    ALL,
    ERROR_FACTOR,
    ESTIMATED,
    LOST,
    REFERENCE,
    ComparisonRow,
    Reference,
    compare_modes,
    pooled,
)
from online.stored_reference import check_reference
from online.stored_replays import ReplaySummary, StoredReplay, StoredReplayError


def compare(study: Study) -> list[ComparisonRow]:
    """Compare the replays that were made, and write tables and pictures.

    The untrained bank is compared with the other modes if it was replayed on all test sequences,
    and with the baseline alone if only these two were replayed.

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
    names, modes = _replayed(study, setup)
    model = _check_replays(study, setup, names, modes)
    rows: list[ComparisonRow] = []
    for name in names:
        folder = study.folder / "replays" / name
        replays = {mode: StoredReplay.read(folder / mode) for mode in modes}
        reference = _reference(study, name)
        rows += compare_modes(name, _with_rivals(replays, model), reference)
        draw_replays(
            study.folder / "comparison" / f"{name}.png",
            f"{study.name}: {name}",
            study.config.sub_trajectory,
            {mode: _track(replay, reference, model) for mode, replay in replays.items()},
            None if reference.trajectory is None else _seen_from(reference.trajectory),
            setup.odometry.space.logarithmic,
            reference.estimated,
        )
    if len({row.sequence for row in rows if row.rte is not None}) > 1:
        rows += pooled(rows)
    report.write_rows(study.folder / "comparison", "comparison", [row.columns() for row in rows])
    return rows


def _reference(study: Study, name: str) -> Reference:
    """What judges the replays of a sequence.

    An estimated one is computed with odometries of its own, never with the members of a bank.
    """
    folder, stored = study.folder / "replays" / name, study.sequences.estimate(name)
    return Reference.read(folder, study.config.sub_trajectory, stored)


def _replayed(study: Study, setup: ReplaySetup) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The sequences and the modes to compare, in the order in which lines lie on each other."""

    def any_of(names: Sequence[str], modes: Collection[str]) -> bool:
        folders = (study.folder / "replays" / name / mode for name in names for mode in modes)
        return any((folder / "replay.json").exists() for folder in folders)

    names, without_model = study.config.test, sequences_without_model(study)
    rivals = [rival for rival in RIVALS if all(any_of([name], [rival]) for name in names)]
    modes = (BASELINE, *rivals, "fixed", *setup.rules)
    of_model = [mode for mode in modes if mode not in WITHOUT_MODEL]
    if not any_of(names, of_model) and any_of(without_model, [UNTRAINED]):
        return without_model, WITHOUT_MODEL
    if not names:
        raise StoredReplayError("test: name at least one sequence to compare on")
    if all(any_of([name], [UNTRAINED]) for name in names):
        return names, tuple(sorted({*modes, UNTRAINED}, key=list(LINES).index))
    return names, modes


def tables(rows: Sequence[ComparisonRow], length: float) -> list[Table]:
    """The rows for the terminal: errors over `length` metres, and, if known, those of evo."""
    several = rows[-1].sequence == ALL
    caption = (
        "Intervals of 95 %: block bootstrap over time, if the sequence is long enough; seed 0."
    )
    if several:
        caption += " `all`: mean RTE, and geometric mean of the ratios."
    unknown = set()
    if all(row.estimated is None for row in rows):
        unknown.add(ESTIMATED)
    else:
        caption += " Estimated: by the odometry itself while driving, without the reference."
    if not any(row.lost_seconds for row in rows):
        unknown.add(LOST)
    if all(row.reference == "given" for row in rows):
        unknown.add(REFERENCE)
    judged = any(row.reference == "estimated" for row in rows)
    if judged:
        caption += (
            f" The error of an estimated reference pulls ratios towards 1, or hides what a mode "
            f"has in common with it; intervals allow for {ERROR_FACTOR:g} times its estimate."
        )
    columns = [{k: v for k, v in row.columns().items() if k not in unknown} for row in rows]
    where = " on test sequences" if rows[0].yardstick == "fixed" else ""
    made = [report.table(f"RTE over {length:g} m{where}", columns, caption)]
    standard = [row.standard for row in rows if row.standard]
    if not standard:
        return made
    kitti = any(errors.kitti.lengths for errors in standard)
    title = (
        "Errors as evo and KITTI's benchmark define them" if kitti else "Errors as evo defines them"
    )
    caption = "APE after alignment, RPE from scan to scan: root mean squares."
    if judged:
        caption += " An estimated reference counts as if it were true."
    if kitti:
        caption += " KITTI: mean over the lengths in the last column; needs 100 m."
    if several:
        caption += " `all`: mean APE and RPE" + (
            "; KITTI over the sub-trajectories of all sequences." if kitti else "."
        )
    return [*made, report.table(title, [row.standard_columns(kitti) for row in rows], caption)]


def _track(replay: StoredReplay, reference: Reference, model: ErrorModel | None) -> Track:
    stamps, known = replay.trajectory.stamps, reference.trajectory
    # The odometry's own frame begins elsewhere: both are drawn from the first common pose.
    start = 0 if known is None else int(np.argmax(np.isin(stamps, known.stamps)))
    return Track(
        (stamps - stamps[0]) * 1e-9,
        _seen_from(replay.trajectory, start),
        reference.errors(replay.trajectory),
        reference.errors_behind(replay.trajectory),
        replay.restarted,
        np.asarray((replay.choice_stamps - stamps[0]) * 1e-9),
        replay.choices,
        {
            str(trial) if model is None or trial not in model.sets else named(model, trial): weights
            for trial, weights in replay.weights.items()
        },
        replay.estimated,
        replay.lost,
    )


def _seen_from(trajectory: Trajectory, start: int = 0) -> NDArray[np.float64]:
    """Positions in the plane of the sensor at a pose: x forward, y to the left."""
    T = trajectory.T_world_sensor
    return np.asarray((invert(T[start]) @ T)[:, :2, 3])


def _check_replays(
    study: Study, setup: ReplaySetup, names: Sequence[str], modes: Sequence[str]
) -> ErrorModel | None:
    """Refuse replays that are missing, or of another recording, model or configuration.

    Returns
    -------
    ErrorModel or None
        What the replays are of; None if its file is not there any more.
    """
    made = {
        (name, mode): ReplaySummary.read(study.folder / "replays" / name / mode)
        for name in names
        for mode in modes
    }
    path, model = _model_of(study, made.values())
    model = model and setup.pinned(model)
    digest = "" if model is None else model.digest
    # Both read what they are about.
    shared = {name: shared_identity(study, name) for name in names}
    if len({str(summary.about.real_time) for summary in made.values()}) > 1:
        raise StoredReplayError(
            f"{study.folder / 'replays'}: some were made in real time, and others not, or not so; "
            f"run `adaptune online` again, with --rate or without"
        )
    for (name, mode), summary in made.items():
        now, about = shared[name] | {"real_time": None}, summary.about.model_dump()
        # What was made in real time may be compared without saying so.
        about["real_time"] = None
        if model is not None or mode in WITHOUT_MODEL:
            whole = setup.identity(mode, model, digest)
            now |= {key: whole[key] for key in ("model", "parameters")}
            if not _is_automatic(study, whole["switching"], about["switching"]):
                now["switching"] = whole["switching"]
        if differing := [key for key, value in now.items() if about[key] != value]:
            option = "" if path == study.model_path.resolve() else f" --model {path}"
            if mode == UNTRAINED:
                option = " --untrained"
            raise StoredReplayError(
                f"{study.folder / 'replays' / name / mode}: was replayed with another "
                f"{', '.join(differing)}; run `adaptune online{option}` with this study"
            )
    option = " --untrained" if UNTRAINED in modes and "fixed" not in modes else ""
    for name in names:
        folder = study.folder / "replays" / name
        check_reference(folder, study.sequences.reference(name), option)
    return model


def _with_rivals(
    replays: Mapping[str, StoredReplay], model: ErrorModel | None
) -> dict[str, StoredReplay]:
    """The replays by mode; of several odometries the fixed set's for each rival that it is."""
    if model is None or "fixed" not in replays or len(model.sets.space.baselines) == 1:
        return dict(replays)
    same = {mode: replays["fixed"] for mode in RIVALS if model.rivals.get(mode) == model.fixed}
    every = {**same, **replays}
    return {mode: every[mode] for mode in LINES if mode in every}


def _model_of(study: Study, summaries: Collection[ReplaySummary]) -> tuple[Path, ErrorModel | None]:
    """File of the model that all replays are of, and the model if the file is still there."""
    own = study.model_path.resolve()
    files = {s.about.model: s.model_file for s in summaries if s.about.model and s.model_file}
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
