"""What an evaluation has found, in words."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from adaptune.errors import Finding
from adaptune.evaluation.judged import Judged

if TYPE_CHECKING:
    from adaptune.evaluation.evaluated import Compared

_MOST = 5  # sentences
_SAID = 2  # faults, unknown stretches and other trajectories that are told one by one
ALIKE = (
    "A judge from scans is blind to what all registrations get wrong alike, as a scale of the "
    "ranges; a trajectory that comes from registrations of the same scans shares that."
)


def in_words(judged: Sequence[Judged], pairs: Sequence["Compared"]) -> list[str]:
    """What to do, how wrong the trajectories are, and how sure that is; five sentences at most."""
    said = [_mend(one) for one in judged if any(cause.mend for cause in one.causes)][:_SAID]
    shown = judged[0]
    if pairs:
        mine = [one for one in judged if one.name == pairs[0].better]
        shown = mine[0]
        said += [f"{_error(shown)}.", _better(pairs)]
    else:
        worst = "The worst: " * (len(judged) > 1)
        said.append(f"{worst}{_error(shown)}.")
    said.append(_where(shown))
    said += _faults(judged)
    said += _unknown(judged)
    return said[:_MOST]


def _mend(one: Judged) -> str:
    cause = next(cause for cause in one.causes if cause.mend)
    return f"{one.title}: {cause}."


def _error(one: Judged) -> str:
    """The error of a trajectory, how sure it is, and who says so."""
    assert one.rte is not None
    reference = one.judge.reference
    judge = f"by {one.judge.name}"
    if reference.error is None:
        judge += ", whose own error is not known"
    else:
        judge += f", whose own error, about {reference.error:.2g} %, is in the interval"
    over = f"over {reference.length:g} m"
    who = f"{one.title}"
    if one.blind:
        most = max(one.interval[1] if one.interval else 0.0, one.rte)
        return f"{who} is better than can be told here: below {most:.2g} % {over}, {judge}"
    sure = "too short for an interval"
    if one.interval is not None:
        sure = "95 % interval {:.2f} to {:.2f}".format(*one.interval)
    return f"{who} is wrong by {one.rte:.2f} % {over} ({sure}), {judge}"


def _better(pairs: Sequence["Compared"]) -> str:
    """How much better the best trajectory is than the others, and how surely."""
    said = []
    for pair in pairs[:_SAID]:
        ends = pair.ratio.interval
        times = f"{pair.ratio.value:.2f} times {pair.other}'s error"
        if ends is None:
            said.append(f"nobody can tell it from {pair.other}: {times}, on too short a path")
        elif ends[1] < 1.0:
            said.append(f"it surely has {times} ({ends[0]:.2f} to {ends[1]:.2f})")
        else:
            said.append(f"nobody can tell it from {pair.other}: {times} ({_ends(ends)})")
    text = "; ".join(said)
    return f"{text[0].upper()}{text[1:]}."


def _ends(ends: tuple[float, float]) -> str:
    return f"{ends[0]:.2f} to {ends[1]:.2f}"


def _where(one: Judged) -> str:
    """The drift, and where a trajectory was worst."""
    said = ""
    if one.drift is not None:
        said = f"It drifts by {one.drift[0]:.2g} m in a hundred, measured over {one.drift[1]:g} m; "
    if one.worst is None:
        return f"{said}where it was worst is not known."
    x, y, _ = one.truth[one.worst, :3, 3]
    at = f"at {one.seconds[one.worst]:.1f} s, x {x:.1f} y {y:.1f} m"
    return f"{said}it was worst {at}: {one.around[one.worst]:.2g} %."


def _listed(findings: Sequence[Finding]) -> str:
    more = f" and {len(findings) - _SAID} times more" * (len(findings) > _SAID)
    return "; ".join(map(str, findings[:_SAID])) + more


def _faults(judged: Sequence[Judged]) -> list[str]:
    """Where trajectories jumped, stood still, gave nothing, or were not there."""
    said = []
    for one in judged:
        found = [*(cause for cause in one.causes if not cause.mend), *one.faults]
        words = [*([one.covered] if one.covered else []), *([_listed(found)] if found else [])]
        if words:
            said.append(f"{one.title} {'; '.join(words)}.")
    if said:
        return said[:_SAID]
    who = "It" if len(judged) == 1 else "None"
    return [f"{who} jumps, stands still while the robot moves, or pauses."] * (who != "It") or [
        "It neither jumps, nor stands still while the robot moves, nor pauses."
    ]


def _unknown(judged: Sequence[Judged]) -> list[str]:
    """How much of the time nobody can judge."""
    worst = max(judged, key=lambda one: one.unknown_share)
    if worst.unknown_share < 0.005:
        return []
    where = [Finding((), why, seconds=(a, b)) for a, b, why in worst.judge.unknown]
    listed = f": {_listed(where)}" if where else ""
    share = f"{100.0 * worst.unknown_share:.0f} % of {worst.judge.recording}"
    return [f"Unknown for {share}, where the judge has no pose{listed}."]
