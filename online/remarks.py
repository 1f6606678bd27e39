"""A comparison in words."""

from collections.abc import Mapping, Sequence

from online.comparison_row import ALL, ComparisonRow
from online.verdict import verdict

_WHOLE = 0.95
"""Share of the longest replay's scans that a whole replay has at least."""


def remarks(rows: Sequence[ComparisonRow]) -> list[str]:
    """In words: what was gained, and what must be known to trust it."""
    rows = [row for row in rows if not row.twin]
    return (
        verdict(rows)
        + _lengths(rows)
        + _judges(rows)
        + _estimates(rows)
        + _losses(rows)
        + _kept_up(rows)
        + _restarts(rows)
    )


def _lengths(rows: Sequence[ComparisonRow]) -> list[str]:
    """A sentence about every sequence whose replays have different lengths."""
    said = []
    for name in dict.fromkeys(row.sequence for row in rows if row.sequence != ALL):
        scans = {row.mode: row.scans for row in rows if row.sequence == name and row.scans}
        if short := short_replays(scans):
            said.append(of_lengths(name, scans, short))
    return said


def short_replays(scans: Mapping[str, int]) -> list[str]:
    """The modes whose replays of a sequence are shorter than the longest, given their scans."""
    # In real time, some scans are dropped.
    return [mode for mode, n in scans.items() if n < _WHOLE * max(scans.values())]


def of_lengths(name: str, scans: Mapping[str, int], short: Sequence[str]) -> str:
    """A sentence about the replays of a sequence of which some are short, given their scans."""
    listed = ", ".join(f"{mode} {scans[mode]}" for mode in short)
    return (
        f"On {name} the replays have different lengths ({listed} of {max(scans.values())} scans); "
        f"errors are compared where all have scans. Run `adaptune online --again`."
    )


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
    contradicted: dict[str, list[str]] = {}
    for row in rows:
        if row.estimated is None or row.sequence == ALL:
            continue
        ends = row.estimated_interval
        interval = "" if ends is None else f"95 % interval {ends[0]:.3f}-{ends[1]:.3f} %"
        if row.rte is None:
            said.append(
                f"{row.sequence} has no reference. `{row.mode}` estimates its own mean RTE there: "
                f"{row.estimated:.3f} %{interval and f' ({interval})'}."
            )
        elif ends is not None and not ends[0] <= row.rte <= ends[1]:
            contradicted.setdefault(row.mode, []).append(
                f"{row.estimated:.3f} % ({interval}) on {row.sequence}, where by the "
                f"{_called(row)} it is {row.rte:.3f} %"
            )
    for mode, those in contradicted.items():
        said.append(
            f"`{mode}` estimates its own mean RTE at {'; '.join(those)}. "
            f"Either the estimate or the reference is wrong there over this length."
        )
    return said


def _called(row: ComparisonRow) -> str:
    """What the reference of a row is called in a sentence."""
    return "estimated reference" if row.reference == "estimated" else "reference"


def _losses(rows: Sequence[ComparisonRow]) -> list[str]:
    """A sentence about every mode that was lost for a while."""
    said = []
    for mode in dict.fromkeys(row.mode for row in rows):
        lost = {
            row.sequence: row.lost_seconds
            for row in rows
            if row.mode == mode and row.lost_seconds and row.sequence != ALL
        }
        if lost:
            on = ", ".join(f"{name} ({seconds:.1f} s)" for name, seconds in lost.items())
            said.append(f"`{mode}` was lost for {sum(lost.values()):.1f} s: on {on}.")
    return said


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
