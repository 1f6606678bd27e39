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
from adaptune.study.driven import RIVAL_WORDS, RIVALS, named
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
from online.stored_reference import is_reference_of
from online.stored_replays import ReplaySummary, StoredReplay, StoredReplayError

NO_DIFFERENCE = 0.01
"""Share of the yardstick's error by which others may differ without it being told."""


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


def remarks(rows: Sequence[ComparisonRow]) -> list[str]:
    """In words: the mean errors, which modes differ, and what the health check did."""
    said = []
    # The last rows are those over all sequences.
    last = {row.mode: row for row in rows if row.sequence == rows[-1].sequence}
    if all(row.rte is not None for row in last.values()):
        found = ", ".join(f"{mode} {row.rte:.3f} %" for mode, row in last.items())
        said.append(f"Mean RTE of {_where(rows[-1])}: {found}.")
    if "fixed" in last and "baseline" in last and (verdict := _of_baseline(last["baseline"])):
        said.append(verdict)
    single = ("baseline", "fixed", *RIVALS)
    adaptive = [row for mode, row in last.items() if mode not in single]
    if differing := [row for row in adaptive if _counts(row)]:
        each = (
            f"`{row.mode}` is {'better' if row.ratio < 1.0 else 'worse'}, with {_times(row)}"
            for row in differing
            if row.ratio is not None
        )
        other = _YARDSTICKS[rows[-1].yardstick]
        said.append(f"Compared with the {other}, {', and '.join(each)} its error.")
    if unknown := [f"`{row.mode}`" for row in adaptive if _is_unknown(row)]:
        said.append(
            f"{rows[-1].sequence} is too short for intervals: whether {' or '.join(unknown)} "
            f"differs from the {_YARDSTICKS[rows[-1].yardstick]} is not known."
        )
    return (
        said
        + _against_rivals(last)
        + _judges(rows)
        + _estimates(rows)
        + _losses(rows)
        + _restarts(rows)
    )


_YARDSTICKS = {"fixed": "fixed set", "baseline": "baseline"}
"""What a mode that others are compared with is called in a sentence."""


def _against_rivals(last: Mapping[str, ComparisonRow]) -> list[str]:
    """How `paired` compares with its rivals, in error and in cost."""
    paired = last.get("paired")
    if paired is None or paired.ratio is None or paired.cpu_ms is None:
        return []
    return [
        f"Compared with {RIVAL_WORDS[rival]}, `paired` has {paired.ratio / row.ratio:.2f} times "
        f"its error, at {paired.cpu_ms:.1f} ms of CPU time a scan against {row.cpu_ms:.1f}."
        for rival in RIVALS
        if (row := last.get(rival)) is not None and row.ratio and row.cpu_ms is not None
    ]


def _judges(rows: Sequence[ComparisonRow]) -> list[str]:
    """A sentence about every sequence that an estimated reference judges."""
    judged = {row.sequence: row for row in rows if row.sequence != ALL}
    said = []
    for name, row in judged.items():
        if row.reference != "estimated":
            continue
        if row.reference_error is None:
            own = "its own error is not known, and not in the intervals"
        elif row.rte_interval is None:
            own = f"its own error is about {row.reference_error:.2g} %"
        else:
            own = f"its own error, about {row.reference_error:.2g} %, is in the intervals"
        said.append(f"On {name} an estimated reference judged: {own}.")
    return said


def _estimates(rows: Sequence[ComparisonRow]) -> list[str]:
    """What is estimated where there is no reference, and where the reference contradicts it."""
    said = []
    for row in rows:
        if row.estimated is None or row.sequence == ALL:
            continue
        ends = row.estimated_interval
        interval = "" if ends is None else f" (95 % interval {ends[0]:.3f}-{ends[1]:.3f} %)"
        if row.rte is None:
            said.append(
                f"{row.sequence} has no reference. `{row.mode}` estimates its own mean RTE there: "
                f"{row.estimated:.3f} %{interval}."
            )
        elif ends is not None and not ends[0] <= row.rte <= ends[1]:
            said.append(
                f"On {row.sequence} `{row.mode}` estimates its own mean RTE at "
                f"{row.estimated:.3f} %{interval}; by the {_called(row)} it is {row.rte:.3f} %. "
                f"One of the two is wrong over this length."
            )
    return said


def _called(row: ComparisonRow) -> str:
    """What the reference of a row is called in a sentence."""
    return "estimated reference" if row.reference == "estimated" else "reference"


def _losses(rows: Sequence[ComparisonRow]) -> list[str]:
    """A sentence about every replay that was lost for a while."""
    return [
        f"On {row.sequence} `{row.mode}` was lost for {row.lost_seconds:.1f} s."
        for row in rows
        if row.lost_seconds and row.sequence != ALL
    ]


def _counts(row: ComparisonRow) -> bool:
    """Whether a mode differs from the yardstick by what counts, as far as it is known."""
    if row.ratio is None or abs(row.ratio - 1.0) < NO_DIFFERENCE or _is_unknown(row):
        return False
    low, high = row.ratio_interval or (row.ratio, row.ratio)
    return not low <= 1.0 <= high


def _is_unknown(row: ComparisonRow) -> bool:
    """Whether a mode may differ from the yardstick, and nobody can tell."""
    if row.ratio is None or row.ratio_interval is not None or row.sequence == ALL:
        return False
    return abs(row.ratio - 1.0) >= NO_DIFFERENCE


def _times(row: ComparisonRow) -> str:
    ends = row.ratio_interval
    interval = "" if ends is None else f" (95 % interval {ends[0]:.2f}-{ends[1]:.2f})"
    return f"{row.ratio:.2f} times{interval}"


def _where(row: ComparisonRow) -> str:
    return "all sequences" if row.sequence == ALL else row.sequence


def _of_baseline(row: ComparisonRow) -> str | None:
    if row.ratio is None:
        return None
    has = f"on {_where(row)} the baseline has {_times(row)}"
    if _is_unknown(row):
        return (
            f"{row.sequence} is too short to tell whether the fixed set is better than the "
            f"baseline: {has} the fixed set's error, with no interval."
        )
    if not _counts(row):
        return (
            f"There is no difference that counts between the baseline and the fixed set here: "
            f"{has} the fixed set's error."
        )
    better, other = ("baseline", "fixed set") if row.ratio < 1.0 else ("fixed set", "baseline")
    return f"The {better} is better than the {other} here: {has} the fixed set's error."


def _restarts(rows: Sequence[ComparisonRow]) -> list[str]:
    """For each sequence a sentence about the modes that the health check restarted."""
    said = []
    for name in dict.fromkeys(row.sequence for row in rows if row.first_restart is not None):
        mine = [row for row in rows if row.sequence == name]
        modes: dict[str, list[str]] = {}
        for row in mine:
            if row.first_restart is not None:
                at = f"at {row.first_restart:.1f} s"
                when = at if row.restarts == 1 else f"{row.restarts} times, first {at}"
                modes.setdefault(f"{when} ({', '.join(row.unhealthy)})", []).append(row.mode)
        each = (
            f"{'all modes' if len(those) == len(mine) else ', '.join(those)} {what}"
            for what, those in modes.items()
        )
        said.append(f"On {name} the health check restarted {'; '.join(each)}.")
    return said


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
    digest = "" if model is None else model.digest
    # Both read what they are about.
    shared = {name: shared_identity(study, name) for name in names}
    for (name, mode), summary in made.items():
        now, about = dict(shared[name]), summary.about.model_dump()
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
        if not is_reference_of(study.folder / "replays" / name, study.sequences.reference(name)):
            raise StoredReplayError(
                f"{study.folder / 'replays' / name}: was judged by another reference; run "
                f"`adaptune online{option}` with this study, which replays nothing for it"
            )
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
