"""Evaluate trajectories in one call: find the judge, judge, compare, and write the page."""

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from adaptune._system.progress import Progress, bars_and_words
from adaptune.errors import AdaptuneError
from adaptune.evaluation.given import Convention, Named, by_name, convention, read
from adaptune.evaluation.judged import Judge, Judged, pair_of, shared_stamps
from adaptune.evaluation.shown import Compared, in_words, write_evaluation
from adaptune.paired import ratio
from adaptune.recording.config import ESTIMATED
from adaptune.recording.fleet import Reading
from adaptune.recording.inspect import Inspection
from adaptune.recording.recording import RecordedSequence, wants_estimate
from adaptune.reference import check, diagnosis
from adaptune.reference.judge import Reference
from adaptune.study.references import ensure_references
from adaptune.study.sequences import StudySequences
from adaptune.trajectory import Trajectory, read_trajectory
from adaptune.tuning.asked import Asked, check_guarded, recorded

OUT = Path("runs/evaluate")
_SILENT = 0.1  # share of a recording that may lack poses where an error is surely below a bound
_OWN_POSES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
"""Poses that systems seldom publish: where a bag has one such topic, it is its reference."""


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """What an evaluation has found."""

    judged: Sequence[Judged]  # the worst first
    pairs: Sequence[Compared]  # the best trajectory against each other one
    page: Path  # HTML, with all charts and tables

    @property
    def words(self) -> list[str]:
        """What was found, in at most five sentences."""
        return in_words(self.judged, self.pairs)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """A row for each trajectory on each recording, as for ``pandas.DataFrame``."""
        return [{key.lstrip("_"): v for key, v in one.row.items()} for one in self.judged]

    def verdict(self, most: float) -> Literal["above", "below", "unclear"]:
        """Whether any error is surely above so many percent, or surely none is.

        What a trajectory does not give, or what is clipped, is not surely below.
        """
        ends = [one.interval or (0.0, math.inf) for one in self.judged]
        if any(low > most for low, _ in ends):
            return "above"
        whole = all(one.silent_share < _SILENT and not one.clipped for one in self.judged)
        return "below" if whole and all(high <= most for _, high in ends) else "unclear"

    def __repr__(self) -> str:
        return f"<Evaluation: {' '.join(self.words)} More: {self.page}>"


def evaluate(
    recordings: str | Path | Sequence[str | Path],
    *trajectories: Named,
    reference: str | Path | None = None,
    points: str | None = None,
    extrinsic: Any = None,
    clock_offset: float = 0.0,
    pose_time: Literal["stamp", "end"] = "stamp",
    sub_trajectory: float | None = None,
    reading: Reading | None = None,
    out: str | Path = OUT,
    progress: Progress | None = None,
) -> Evaluation:
    """Say how wrong trajectories are, as the command `evaluate` does, without ground truth, too.

    An AdaptuneError says what to do about a recording, a trajectory or a reference.

    Parameters
    ----------
    recordings
        Bags, or folders of them; `reading`, ``"one"`` or ``"several"``, says how to read these.
    trajectories
        Files; topics, also of other bags (``"run2.bag:/odom"``); chains of transforms
        (``"/tf:map.base_link"``); `Trajectory` objects; or pairs of stamps (nanoseconds, or
        seconds) and poses of shape (n, 4, 4).
    reference, points
        What judges, where not the recording's own poses: a topic, a file, or ``"estimated"``; and
        the topic of the scans, where there are several.
    extrinsic, clock_offset, pose_time
        The LiDAR's pose in the poses' frame, as ``x y z qx qy qz qw`` or a matrix; the seconds to
        add to their stamps; and ``"end"`` if they are of the ends of scans.
    sub_trajectory
        Metres over which errors are measured; by default as the length of the path allows.
    out, progress
        Folder of the page, the tables and the estimated references; and what is called with how
        far each task is, by default bars.
    """
    check_guarded("evaluate")
    if not trajectories:
        raise AdaptuneError("name a trajectory: a file of poses, or a topic")
    if sub_trajectory is not None and not 0.0 < sub_trajectory < math.inf:
        raise AdaptuneError("sub_trajectory (--sub-trajectory): give metres, more than 0")
    given = [recordings] if isinstance(recordings, str | Path) else recordings
    by = convention(extrinsic, clock_offset, pose_time)
    chosen = None if reference is None else str(reference)
    paths = Asked([*map(Path, given)], "", points, chosen or ESTIMATED, reading=reading)
    with ExitStack() as stack:
        show = progress or stack.enter_context(bars_and_words())
        found, _ = recorded(paths, show, alike=False)
        named = by_name(trajectories)
        for one, of in named.items() if len(found) > 1 else ():
            if not (isinstance(of, str) and of.startswith("/")) or Path(of).is_file():
                what = f"is of one recording, and there are {len(found)}; name topics that each has"
                raise AdaptuneError(f"{one}: {what}")
        asked = _Asked(named, chosen, sub_trajectory, by, Path(out), show)
        judged = [one for name in found for one in _of_recording(name, found[name], asked)]
    judged.sort(key=lambda one: -one.rte)
    pairs = _pairs(judged)
    return Evaluation(judged, pairs, write_evaluation(asked.out, judged, pairs))


class _Asked(NamedTuple):
    trajectories: Mapping[str, Named]
    reference: str | None
    length: float | None
    by: Convention
    out: Path
    show: Progress
    poses: Collection[Trajectory] = ()  # of the trajectories, on one recording

    def length_of(self, judge: Trajectory) -> float:
        """Metres over which errors are measured, as the paths that the judge knows allow."""
        shared = [stamps for one in self.poses if len(stamps := shared_stamps(judge, one))]
        paths = [Trajectory(stamps, judge.at(stamps)) for stamps in shared] or [judge]
        return self.length or min(check.proposed_sub_trajectory(p, training=0.0) for p in paths)


def _of_recording(name: str, found: Inspection, asked: _Asked) -> list[Judged]:
    """All trajectories of a recording, judged."""
    if asked.reference is None:
        found.given["reference"] = _own_reference(found, asked.trajectories)
    scans, span = RecordedSequence(found.config()), found.scan.span if found.scan else 0
    # A trajectory that cannot be read is told before a reference is estimated.
    poses = {n: read(n, one, scans, asked.by, span) for n, one in asked.trajectories.items()}
    asked = asked._replace(poses=poses.values())
    judge, place = _judge(name, found, scans, asked), asked.by.T_body_sensor
    judged = []
    for called, trajectory in poses.items():
        stamps = shared_stamps(judge.trajectory, trajectory)
        cause = diagnosis.diagnose_trajectory(trajectory, judge.trajectory, stamps, span, place)
        cause = None if judge.doubt else cause
        judged.append(Judged(called, judge, trajectory, stamps, cause))
    return judged


def _own_reference(found: Inspection, trajectories: Collection[str]) -> str | None:
    """The recording's own poses, where they are not among what is judged; else an estimate."""
    if found.reference is not None and "reference" not in found.used:
        return None  # those of a folder
    own = [topic.name for topic in found.topics.values() if topic.type in _OWN_POSES]
    return own[0] if len(own) == 1 and own[0] not in trajectories else ESTIMATED


def _judge(name: str, found: Inspection, scans: RecordedSequence, asked: _Asked) -> Judge:
    """What judges: a given reference, or an estimated one.

    Where scans show that the recording's own is wrong, and nobody named it, it does not judge.
    """
    config, error, doubt = found.config(), None, ""
    called = config.reference or "its own poses"
    given = None if wants_estimate(config) else scans.reference()
    stored = StudySequences({name: config}, {}, asked.out).estimate(name)
    if given is not None and stored is None:
        error, doubt = _against(scans, given, asked)
    if given is None or (doubt and asked.reference is None):
        found.given["reference"] = ESTIMATED
        sequences = StudySequences({name: found.config()}, {}, asked.out)
        length, must = asked.length or 5.0, given is None
        if why := ensure_references(sequences, [name], length, asked.show, must).get(name):
            doubt += f", and none can be estimated: {why}"
        else:
            given, stored = read_trajectory(sequences.estimate_path(name)), sequences.estimate(name)
            called = "an estimated reference" + f" (as {called} {doubt})" * bool(doubt)
            doubt = ""
    assert given is not None  # else there is an error
    reference = Reference.known(given, asked.length_of(given), stored)
    reference = reference if stored else reference._replace(error=error)
    begin, end = scans.source.span() or given.stamps[[0, -1]].tolist()
    return Judge(name, reference, called, begin, end, stored.unknown if stored else (), doubt)


def _against(scans: RecordedSequence, given: Trajectory, asked: _Asked) -> tuple[float | None, str]:
    """Percent by which a given reference surely errs, and in words what the scans say against it.

    Both are empty where they show nothing.
    """
    measured = check.measure_reference(scans, given, partial(asked.show, "registering"))
    error = measured.error(length := asked.length_of(given))
    if error is None or measured.is_noisy(length):
        motions = diagnosis.measured_motions(scans, len(measured.stamps))
        if (cause := diagnosis.diagnose_reference(given, measured.stamps, motions)) is not None:
            return None, f"contradicts the scans ({cause})"
        if error is not None and asked.reference is None:
            return error.low, f"is wrong by {error.mean:.2g} %"
    return None if error is None or measured.doubt else error.low, ""


def _pairs(judged: Sequence[Judged]) -> list[Compared]:
    """The best trajectory against each other one, on the recordings that have both."""
    by: dict[str, dict[str, Judged]] = {}
    for one in judged:
        by.setdefault(one.name, {})[one.judge.recording] = one
    means = {name: float(np.mean([one.rte for one in of.values()])) for name, of in by.items()}
    best, *others = sorted(means, key=lambda name: means[name])
    found = []
    for other in others:
        both = [pair_of(by[best][r], by[other][r]) for r in by[best]]
        if known := [pair for pair in both if pair.errors.size]:
            found.append(Compared(best, other, ratio(known)))
    return found
