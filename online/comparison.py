"""The comparison of baseline, fixed and adaptive on the replayed sequences."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from adaptune import report
from adaptune.drawing import LINES
from adaptune.model import ErrorModel
from adaptune.study.driven import EQUAL_COST, RIVALS
from adaptune.study.oracle_runs import read_oracle
from adaptune.study.study import Study
from online.compared_modes import compared_modes
from online.comparison_row import ComparisonRow
from online.comparison_tables import tables
from online.hindsight import oracle_rows
from online.modes import UNTRAINED, ReplaySetup
from online.pooled_rows import pooled, ratio_to, with_gaps
from online.remarks import remarks
from online.replay_picture import draw_replays, drawn_modes
from online.stale_replays import check_replays
from online.statistics import JudgedModes, Repeats, compare_modes
from online.stored_replays import StoredReplay, read_repeats
from online.tracks import reference_of, seen_from, track_of
from online.verdict import CONTROLS


class ComparedReplays(NamedTuple):
    """What `compare` has found."""

    # A row for every sequence and mode; over several sequences, a row for every mode follows.
    rows: list[ComparisonRow]
    words: list[str]  # sentences: what was gained, and what must be known to trust it
    unfinished: Sequence[str] = ()  # sequences that are not compared, for want of replays


def compare(study: Study, write: bool = True) -> ComparedReplays:
    """Compare the replays that were made, and write tables and pictures.

    A mode is compared if it was replayed on all sequences that are compared, see
    `online.compared_modes.compared_modes`. The untrained bank is compared with the baseline alone
    if only these two were replayed.

    Parameters
    ----------
    study
        The study; ``comparison`` in its folder receives ``comparison.csv`` and ``.json``, the
        tables as Markdown (``tables.md``) and LaTeX (``tables.tex``), and a picture (PNG and SVG)
        for every sequence.
    write
        Whether it does.

    Raises
    ------
    StoredReplayError
        If that of the fixed set is missing, or one is damaged, or of another recording or
        configuration.
    """
    setup, compared = ReplaySetup.of(study), compared_modes(study)
    names, modes = compared.sequences, compared.modes
    model = check_replays(study, setup, names, modes)
    judged: list[JudgedModes] = []
    oracles: list[ComparisonRow] = []
    for name in names:
        folder = study.folder / "replays" / name
        replays = {mode: read_repeats(folder / mode) for mode in modes}
        reference = reference_of(study, name)
        every = _with_twins(replays, model, compared.twins)
        of_modes = compare_modes(name, every, reference)
        judged.append(of_modes._replace(recording=study.sequences.recorded_in(name)))
        oracle = None if model is None else read_oracle(study, name, model)
        if oracle is not None and model is not None:
            period = study.config.online.period
            oracles += oracle_rows(judged[-1], oracle, model.fixed, period)
        if not write:
            continue
        draw_replays(
            study.folder / "comparison" / f"{name}.png",
            f"{study.name}: {name}",
            study.config.sub_trajectory,
            {mode: track_of(replays[mode][0], reference, model) for mode in drawn_modes(modes)},
            None if reference.trajectory is None else seen_from(reference.trajectory),
            setup.odometry.space,
            reference.estimated,
        )
    twins = compared.twins
    rows = [replace(row, twin=twins.get(row.mode, "")) for row in _rows(judged, oracles)]
    words = [*remarks(rows), *_equal_cost(model, modes), *compared.words(study)]
    words += _missing_repeats(judged, study.config.online.repeats)
    words += _without_oracle(judged, oracles) if model is not None else []
    if write:
        folder = study.folder / "comparison"
        report.write_rows(folder, "comparison", [row.columns() for row in rows])
        made = tables(rows, study.config.sub_trajectory)
        report.write_tables(folder, study.name, made, words)
    return ComparedReplays(rows, words, compared.unfinished)


def _equal_cost(model: ErrorModel | None, modes: Sequence[str]) -> list[str]:
    """That the fixed set is its own rival, if it is and is compared."""
    if model is None or "fixed" not in modes or model.rivals.get(EQUAL_COST) != model.fixed:
        return []
    return [
        "`equal_cost` is the fixed set: in training, no single set that costs no more than what is "
        "driven was better."
    ]


def _missing_repeats(judged: Sequence[JudgedModes], repeats: int) -> list[str]:
    """Which replays were repeated less often than the study says."""
    few = [
        f"{row.mode} on {one.name} {row.repeats}"
        for one in judged
        for row in one.rows
        if row.repeats < repeats
    ]
    what = f"Replayed less often than {repeats} times (`adaptune online` goes on)"
    return [f"{what}: {', '.join(few)}."] if few else []


def _without_oracle(judged: Sequence[JudgedModes], oracles: Sequence[ComparisonRow]) -> list[str]:
    """On which sequences the best choice in hindsight is not known."""
    known = {row.sequence for row in oracles}
    names = [one.name for one in judged if one.rows[0].rte is not None and one.name not in known]
    if not names:
        return []
    where = "" if len(names) == len(judged) else f" on {', '.join(names)}"
    return [f"What the best set would have gained{where} is not known; `adaptune oracle` tells."]


def _rows(judged: Sequence[JudgedModes], oracles: Sequence[ComparisonRow]) -> list[ComparisonRow]:
    """The rows of each sequence, and if there are several, those over all."""
    rows = [row for one in judged for row in one.rows]
    known = [one for one in judged if one.rows[0].rte is not None]
    if not known:
        return rows
    if len(judged) > 1:
        last = pooled(judged, oracles)
    else:
        last, rows = [*with_gaps(rows, oracles), *oracles], []
    return [*rows, *(_against(row, known, last) for row in last)]


def _against(
    row: ComparisonRow, judged: Sequence[JudgedModes], rows: Sequence[ComparisonRow]
) -> ComparisonRow:
    """Compare a mode that adapts with controls and rivals, too, on the same frames."""
    if row.mode not in ("paired", UNTRAINED):
        return row
    others = [other.mode for other in rows if other.mode in (*CONTROLS, *RIVALS)]
    return replace(row, against={other: ratio_to(judged, row.mode, other) for other in others})


def _with_twins(
    replays: Repeats, model: ErrorModel | None, twins: Mapping[str, str]
) -> dict[str, Sequence[StoredReplay]]:
    """The replays by mode, also for each mode that has that of another one.

    Of several odometries, a rival that is the fixed set has its replay.
    """
    same = {mode: replays[twin] for mode, twin in twins.items()}
    if model is not None and "fixed" in replays and len(model.sets.space.baselines) > 1:
        of_fixed = [mode for mode in RIVALS if model.rivals.get(mode) == model.fixed]
        same |= dict.fromkeys(of_fixed, replays["fixed"])
    every = {**same, **replays}
    return {mode: every[mode] for mode in LINES if mode in every}
