"""Evaluate trajectories in one call: find the judge, read, judge, compare, and write the page."""

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.evaluation.given import Convention, Named, PoseTime, name_of, read
from adaptune.evaluation.judged import Judge, Judged, common_stamps, compared, pair_of
from adaptune.evaluation.words import in_words
from adaptune.geometry import to_pose
from adaptune.paired import Ratio
from adaptune.progress import Progress, bars_and_words
from adaptune.recording.config import ESTIMATED
from adaptune.recording.fleet import recordings_at
from adaptune.recording.poses import sound
from adaptune.recording.recording import RecordedSequence, wants_estimate
from adaptune.reference.check import proposed_sub_trajectory
from adaptune.reference.diagnosis import diagnose_trajectory
from adaptune.reference.judge import Reference
from adaptune.study.references import ensure_references
from adaptune.study.sequences import StudySequences
from adaptune.trajectory import read_trajectory
from adaptune.tuning.asked import usable

if TYPE_CHECKING:
    from adaptune.recording.fleet import Reading
    from adaptune.recording.inspect import Inspection

Paths = str | Path | Sequence[str | Path]
OUT = Path("runs/evaluate")
_GROUND_TRUTH = ("Pose", "Transform")
"""Of messages that systems seldom publish: such a topic is a recording's own reference."""


class Compared(NamedTuple):
    """Two trajectories, over the recordings that have both."""

    better: str
    other: str
    ratio: Ratio  # of the error of the better one to that of the other


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """What an evaluation has found.

    `rows` and `errors` are data frames if pandas is installed; else lists of rows.
    """

    judged: Sequence[Judged]  # the worst first
    pairs: Sequence[Compared]  # the best one against each other one
    page: Path  # HTML, with all charts and tables

    @property
    def words(self) -> list[str]:
        """What was found, in at most five sentences."""
        return in_words(self.judged, self.pairs)

    @property
    def rows(self) -> Any:
        """A row for each trajectory on each recording."""
        return _table([one.row for one in self.judged])

    @property
    def errors(self) -> Any:
        """A row for each pose: seconds from the first scan, and its errors in percent."""
        rows = [
            {"recording": one.judge.recording, "trajectory": one.name}
            | dict(zip(("seconds", "RTE [%]", "around [%]"), values.tolist(), strict=True))
            for one in self.judged
            for values in np.column_stack([one.seconds, one.errors, one.around])
        ]
        return _table(rows)

    def verdict(self, most: float) -> str:
        """Whether any error is surely ``"above"`` so many percent, all are ``"below"``, or not."""
        said = {one.verdict(most) for one in self.judged}
        return "above" if "above" in said else "below" if said == {"below"} else "unclear"

    def __repr__(self) -> str:
        return f"<Evaluation: {' '.join(self.words)} More: {self.page}>"


def _table(rows: list[dict[str, Any]]) -> Any:
    try:
        import pandas as pd
    except ImportError:
        return rows
    return pd.DataFrame(rows)


def evaluate(
    recordings: Paths,
    *trajectories: Named,
    reference: str | Path | None = None,
    points: str | None = None,
    extrinsic: Any = None,
    clock_offset: float = 0.0,
    pose_time: PoseTime = "stamp",
    sub_trajectory: float | None = None,
    reading: "Reading | None" = None,
    out: str | Path = OUT,
    progress: Progress | None = None,
) -> Evaluation:
    """Say how wrong trajectories are, as the command `evaluate` does; no ground truth is needed.

    An AdaptuneError says what to do about a recording, a trajectory or a reference.

    Parameters
    ----------
    recordings
        Bags, or folders of them; `reading`, ``"one"`` or ``"several"``, says how to read these.
    trajectories
        Files of poses, topics, topics of other bags (``"run2.bag:/odom"``), chains of transforms
        (``"/tf:map.base_link"``), `Trajectory` objects, arrays of TUM's rows, or pairs of stamps
        (nanoseconds, or seconds) and poses of shape (n, 4, 4).
    reference, points
        What judges, where not the recording's own poses: a topic, a file, or ``"estimated"``; and
        the topic of the scans, where there are several.
    extrinsic, clock_offset, pose_time
        How the poses are given: the LiDAR's pose in their frame, as ``x y z qx qy qz qw`` or a
        matrix, the seconds to add to their stamps, and ``"end"`` if they are of scans' ends.
    sub_trajectory
        Metres over which errors are measured; by default as the length of the path allows.
    out
        Folder of the page, the tables and the estimated references.
    progress
        Called with how far each task is; by default, bars show it.
    """
    if not trajectories:
        raise AdaptuneError("name a trajectory: a file of poses, or a topic")
    if pose_time not in ("stamp", "end"):
        raise AdaptuneError(f"pose_time: give 'stamp' or 'end', not {pose_time!r}")
    if sub_trajectory is not None and not 0.0 < sub_trajectory < math.inf:
        raise AdaptuneError(f"sub_trajectory: give metres, more than 0, not {sub_trajectory:g}")
    try:
        place = None if extrinsic is None else to_pose(extrinsic)
    except ValueError as error:
        raise AdaptuneError(f"extrinsic: {error}") from error
    by = Convention(place, clock_offset, pose_time)
    given = [recordings] if isinstance(recordings, str | Path) else recordings
    paths = recordings_at([Path(path) for path in given], reading)
    one = [name for name in (reference, *trajectories) if len(paths) > 1 and _is_of_one(name)]
    if one:
        raise AdaptuneError(
            f"{name_of(one[0], 1)}: is of one recording, and there are {len(paths)}; of several, "
            f"name topics that each has"
        )
    with ExitStack() as stack:
        show = progress or stack.enter_context(bars_and_words())
        judged = []
        for path, name in zip(paths, _names(paths), strict=True):
            asked = _Asked(path, name, points, reference and str(reference), sub_trajectory)
            judged += _of_recording(asked, trajectories, by, Path(out), show)
        judged.sort(key=lambda one: -math.inf if one.rte is None else -one.rte)
        pairs = _pairs(judged)
        from adaptune.evaluation.page import write_evaluation

        return Evaluation(judged, pairs, write_evaluation(Path(out), judged, pairs))


def _is_of_one(given: Named | None) -> bool:
    """Whether a trajectory, or a reference, can be of a single recording only."""
    if given is None or not isinstance(given, str | Path):
        return given is not None
    return Path(given).is_file() or ":/" in str(given)


def _names(paths: Sequence[Path]) -> Iterator[str]:
    from adaptune.files import plain_name

    taken = set[str]()
    for path in map(Path.resolve, paths):
        longer = plain_name(path.with_name(f"{path.parent.name}_{path.name}"))
        names = (plain_name(path), longer, *(f"{longer}_{n}" for n in range(2, len(paths) + 2)))
        taken.add(name := next(name for name in names if name not in taken))
        yield name


class _Asked(NamedTuple):
    """A recording, and what is to judge on it."""

    path: Path
    name: str
    points: str | None
    reference: str | None
    length: float | None


def _of_recording(
    asked: _Asked, trajectories: Sequence[Named], by: Convention, out: Path, show: Progress
) -> list[Judged]:
    """All trajectories of a recording, judged."""
    found = usable(asked.path, asked.points, asked.reference or ESTIMATED, show)
    if asked.reference is None:
        found.given["reference"] = _own_reference(found, trajectories)
    scans = RecordedSequence(found.config())
    span = found.scan.span if found.scan is not None else 0
    # A trajectory that cannot be read is told before a reference is estimated.
    names = [name_of(given, number) for given, number in zip(trajectories, count(1), strict=False)]
    read_ = [read(given, scans, by, span * 1e-9) for given in trajectories]
    judge = _judge(asked, scans, found, out, show)
    judged = []
    for name, trajectory in zip(names, read_, strict=True):
        stamps = common_stamps(judge.trajectory, trajectory)
        _, causes = sound(trajectory, judge.scans[0], name="")
        if causes and causes[-1].seconds is None:
            raise AdaptuneError(f"{asked.path}: {name}: {causes[-1].what}: two nodes publish it?")
        one = Judged(name, trajectory, judge, stamps)
        if one.rte is None:
            raise AdaptuneError(_too_short(one))
        place = by.T_body_sensor
        what = diagnose_trajectory(trajectory, judge.trajectory, stamps, span, place)
        seen = [c._replace(what=c.what.strip(), mend="") for c in causes]
        judged.append(Judged(name, trajectory, judge, stamps, [*([what] if what else []), *seen]))
    return judged


def _too_short(one: Judged) -> str:
    """Why nothing of a trajectory can be judged."""
    metres, judge = one.judge.reference.length, one.judge
    part = f" {one.covered}, and" if one.covered else ""
    return (
        f"{judge.recording}: {one.name}{part} no {metres:g} m of it can be judged; name a longer "
        f"one, or a smaller sub_trajectory"
    )


def _own_reference(found: "Inspection", trajectories: Sequence[Named]) -> str | None:
    """The recording's own poses, where nothing that is judged is among them; else an estimate."""
    if found.reference is None:
        return ESTIMATED
    if "reference" not in found.used:
        return None  # those of a folder
    words = {str(given).partition(":")[0] for given in trajectories if isinstance(given, str)}
    topics = [
        topic.name
        for topic in found.topics.values()
        if any(word in topic.type for word in _GROUND_TRUTH) and "tf" not in topic.type
    ]
    return topics[0] if len(topics) == 1 and topics[0] not in words else ESTIMATED


def _judge(
    asked: _Asked, scans: RecordedSequence, found: "Inspection", out: Path, show: Progress
) -> Judge:
    """What judges: the reference that is named, the recording's own, or an estimated one."""
    config = found.config()
    begin, end = scans.source.span() or (0, 0)
    if not wants_estimate(config):
        trajectory = scans.reference()
        assert trajectory is not None
        sequences = StudySequences({asked.name: config}, {}, out)
        stored, name = sequences.estimate(asked.name), config.reference or "its own poses"
    else:
        sequences = StudySequences({asked.name: config}, {}, out)
        ensure_references(sequences, [asked.name], asked.length or 5.0, show)
        path = sequences.estimate_path(asked.name)
        trajectory, stored = read_trajectory(path), sequences.estimate(asked.name)
        name = "an estimated reference"
    length = asked.length or proposed_sub_trajectory(trajectory, training=0.0)
    error = None if stored is None else stored.error(length)
    error = None if error is None or math.isnan(error) else error
    reference = Reference(trajectory, length, stored is not None, error)
    unknown = () if stored is None else stored.unknown
    return Judge(asked.name, reference, name, (begin, end), unknown)


def _pairs(judged: Sequence[Judged]) -> list[Compared]:
    """The best trajectory against each other one, on the recordings that have both."""
    by_name: dict[str, dict[str, Judged]] = {}
    for one in judged:
        by_name.setdefault(one.name, {})[one.judge.recording] = one
    means = {
        name: sum(one.rte or 0.0 for one in of.values()) / len(of) for name, of in by_name.items()
    }
    best, *others = sorted(means, key=lambda name: means[name])
    found = []
    for other in others:
        both = [(by_name[best][r], by_name[other][r]) for r in by_name[best] if r in by_name[other]]
        if (ratio := compared([pair_of(*pair) for pair in both])) is not None:
            found.append(Compared(best, other, ratio))
    return found
