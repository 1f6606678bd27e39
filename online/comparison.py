"""The comparison of baseline, fixed and adaptive on the replayed sequences."""

from collections.abc import Sequence

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
    """Refuse replays that are missing, or of another recording or configuration."""
    model = ErrorModel.load(study.model_path) if study.model_path.exists() else None
    own, digest = str(study.model_path.resolve()), "" if model is None else model.digest
    places = [study.folder / "replays" / name for name in study.config.test]
    summaries = [ReplaySummary.read(place / mode) for place in places for mode in setup.modes]
    if model is not None and own in {summary.model_file for summary in summaries}:
        check_model(study, model.sequences, model.provenance)
    for name in study.config.test:
        shared = shared_identity(study, name)
        for mode in setup.modes:
            now = dict(shared)
            folder = study.folder / "replays" / name / mode
            summary = ReplaySummary.read(folder)
            made = summary.about.model_dump()
            if model is not None and summary.model_file == own:
                now |= {
                    key: setup.identity(mode, model, digest)[key] for key in ("model", "parameters")
                }
            if differing := [key for key, value in now.items() if made[key] != value]:
                raise StoredReplayError(
                    f"{folder}: was replayed with another {', '.join(differing)}; run `adaptune "
                    f"online` with this study"
                )
        if not is_reference_of(study.folder / "replays" / name, study.sequences.reference(name)):
            raise StoredReplayError(
                f"{study.folder / 'replays' / name}: was judged by another reference; run "
                f"`adaptune online` with this study, which replays nothing for it"
            )
