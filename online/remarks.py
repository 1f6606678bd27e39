"""A comparison in words."""

from collections.abc import Mapping, Sequence

from adaptune.study.driven import RIVAL_WORDS, RIVALS
from online.statistics import ALL, ComparisonRow

NO_DIFFERENCE = 0.01
"""Share of the yardstick's error by which others may differ without it being told."""


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
        + _kept_up(rows)
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


def _kept_up(rows: Sequence[ComparisonRow]) -> list[str]:
    """Of replays in real time, a sentence about each that did not get all scans or selections."""
    said, timed = [], [(row, row.real_time) for row in rows if row.real_time is not None]
    for row, kept in timed:
        found = [
            f"{kept[key]:.0f} {what}{'' if kept[key] == 1 else 's'}"
            for key, what in (("dropped_scans", "scan"), ("missed_selections", "selection"))
            if kept[key]
        ]
        if found:
            said.append(
                f"On {row.sequence} `{row.mode}` was too late for {' and '.join(found)}, at "
                f"{kept['rate']:g} times the recorded rate; 99 % of its poses came within "
                f"{kept['pose_ms_p99']:.0f} ms of the scans."
            )
        if late := kept.get("late_members_scans"):
            removed = f", and {n:.0f} removed" if (n := kept.get("removed_members")) else ""
            said.append(
                f"On {row.sequence} members of the bank of `{row.mode}` were late at {late:.0f} "
                f"scans in all{removed}."
            )
    if timed and not said:
        rate = timed[0][1]["rate"]
        said.append(f"Replayed at {rate:g} times the recorded rate: nothing came too late.")
    return said


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
