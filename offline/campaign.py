"""The campaign: drive the parameter sets of the search, and store the trials."""

import logging
import math
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.progress import Progress, about, unseen
from adaptune.errors import AdaptuneError
from adaptune.live.hops import Hops
from adaptune.reference.carried import begin_of, left_out
from adaptune.runs.archive import REGISTER_MS, Archive, Frames, Kind, Trial
from adaptune.runs.record import Run
from adaptune.space import ParameterSet, PooledSpace
from adaptune.study.references import contradictions_of
from offline.choice import FINALISTS, OTHERS
from offline.config import OfflineStudy
from offline.drive import trial_of
from offline.frames import Segment, segments_along, segments_of
from offline.objective import JudgedSet, label
from offline.search import ELAPSED, TIME_IS_UP, Search, Stopwatch
from offline.workers import Pool, Result, Task, TaskProgress, run

_log = logging.getLogger(__name__)

SLOW, LEAST_SECONDS = 10.0, 20.0
"""A set is stopped that takes so many times the CPU time of the baseline, and so many seconds."""


@dataclass
class _Due:
    """A trial that is being driven on a sequence."""

    parameters: ParameterSet
    left: int = 0  # segments that are not driven yet
    share: float = 0.0  # of its scans that are
    runs: dict[int, Sequence[Run]] = field(default_factory=dict)  # by first scan


class Schedule:
    """Trials on sequences, each driven segment by segment, by whoever holds the prepared scans.

    A sequence that is not described yet is described first, and the hops along it are measured
    when there is nothing else to do.
    """

    def __init__(
        self,
        study: OfflineStudy,
        archive: Archive,
        what: str,
        progress: Progress = unseen,
        kind: Kind = "",
        measure: bool = True,
    ):
        self.most_ms: Mapping[str, float] = {}  # of CPU time a scan, above which a set is stopped
        self.done = 0  # trials on sequences
        self._archive, self._what, self._progress = archive, what, progress
        self._kind, self._measure = kind, measure
        self._config, self._odometry = study.config, study.odometry
        self._described: dict[str, Frames] = {}
        self._frames: dict[str, Frames] = {}  # the same, with the segments that are driven
        self._unread: list[str] = []
        self._unmeasured: list[str] = []
        self._unsaved: set[str] = set()  # whose frames the archive does not have
        self._due: dict[str, dict[int, _Due]] = {}
        self._segments: dict[Hashable, Segment] = {}
        # By segment and preparation of its scans, the sets that are still to be driven there.
        self._waiting: dict[tuple[Hashable, Hashable], dict[int, ParameterSet]] = {}
        self._partly: dict[Hashable, float] = {}  # by task, how much of it is done

    def need(self, name: str) -> None:
        """Describe a sequence, unless that was done before."""
        if name in self._due:
            return
        self._due[name] = {}
        if self._archive.has_frames(name, self._config.descriptor):
            self._know(name, self._archive.read_frames(name))
        else:
            self._unread.append(name)

    def add(self, name: str, number: int, parameters: ParameterSet) -> None:
        """Drive a set."""
        self.need(name)
        self._due[name][number] = _Due(parameters)
        if name in self._frames:
            self._open(name, number)

    @property
    def total(self) -> int:
        """Trials that are done, or due."""
        return self.done + sum(map(len, self._due.values()))

    def run(self, workers: Pool[Any]) -> Iterator[tuple[str, int, Trial]]:
        """Yield each trial with its sequence and its number; more may be added meanwhile."""
        for task, result in run(workers, self):
            if isinstance(result, Frames):
                self._unsaved.add(task.sequence)
                self._know(task.sequence, result)
            else:
                yield from self._driven(task, result)

    def store(self, name: str, number: int, trial: Trial) -> None:
        """Store a trial, and before it what all on the sequence share: which scans are driven."""
        self._save(name)
        self._archive.write(name, number, trial, self._kind)

    def frames(self, name: str) -> Frames:
        """What all trials on a sequence share."""
        return self._described[name]

    def leave_out(self, name: str, lost: NDArray[np.bool_]) -> None:
        """Let the reference be unknown at these scans, (n,); it counts for drives from now on."""
        frames, config = self._described[name], self._config
        T = np.where(lost[:, None, None], np.nan, frames.T_ref_sensor)
        some = segments_of(T, frames.stamps, config.sub_trajectory, config.segments)
        # The hops along them are measured again.
        frames = replace(
            frames, T_ref_sensor=T, segments=some, hops=Hops.of([]), evidence_ms=np.nan
        )
        self._described[name] = frames
        self._frames[name] = frames.uncut if self._kind else frames
        self._unsaved.add(name)

    def close(self) -> None:
        """Store the frames that no trial was stored with."""
        for name in sorted(self._unsaved):
            self._save(name)

    def waits(self) -> bool:
        """See `offline.workers.Work`."""
        return bool(self._unread or self._waiting or self._unmeasured)

    def take(self, held: Collection[Hashable], others: Collection[Hashable], n: int) -> Task:
        """See `offline.workers.Work`."""
        if self._unread:
            return Task(self._unread.pop(0))
        if not self._waiting:
            name = self._unmeasured.pop(0)
            return Task(name, self._described[name])

        def rank(key: tuple[Hashable, Hashable]) -> tuple[bool, bool, int]:
            return key not in held, key not in held and key in others, min(self._waiting[key])

        key = min(self._waiting, key=rank)
        waiting, segment = self._waiting[key], self._segments[key[0]]
        # Of a search, some are left for the time when the next sets wait.
        size = math.ceil(len(waiting) / max(1 if self._kind else 2, n / len(self._waiting)))
        numbers = sorted(waiting)[: 1 if self._odometry.one_by_one else size]
        sets = {number: waiting.pop(number) for number in numbers}
        if not waiting:
            del self._waiting[key]
        name, n_scans = segment.sequence, len(segment.stamps)
        most_ms, share = self.most_ms.get(name, np.inf), self._share(segment)
        most = max(1e-3 * most_ms * n_scans, LEAST_SECONDS * share)
        return Task(
            name, segment=segment, sets=sets, most=most, bare=self._kind == "bare", prepares=key
        )

    def note(self, task: Task, progress: TaskProgress) -> None:
        """See `offline.workers.Work`."""
        stage, scans, of = progress
        if task.segment is None:
            self._progress(f"{stage} {task.sequence}", scans, of, "")
            return
        share = self._share(task.segment) * scans / max(of, 1)
        self._partly[task.key] = share * len(task.sets)
        self._show()

    def _know(self, name: str, frames: Frames) -> None:
        measured, self._described[name] = name in self._described, frames
        if measured:
            return
        self._frames[name] = frames.uncut if self._kind else frames
        if self._measure and np.isnan(frames.evidence_ms):
            self._unmeasured.append(name)
        for number in self._due[name]:
            self._open(name, number)

    def _open(self, name: str, number: int) -> None:
        due = self._due[name][number]
        preparation = self._odometry(due.parameters).preparation
        for segment in segments_along(name, self._frames[name]):
            self._segments[segment.key] = segment
            self._waiting.setdefault((segment.key, preparation), {})[number] = due.parameters
            due.left += 1

    def _driven(self, task: Task, result: Result) -> Iterator[tuple[str, int, Trial]]:
        assert task.segment is not None
        assert not isinstance(result, Frames)
        name = task.sequence
        self._partly.pop(task.key, None)
        for number, runs in result.items():
            due = self._due[name][number]
            due.runs[task.segment.first] = runs
            due.share += self._share(task.segment)
            due.left -= 1
            if any(run.too_slow for run in runs):
                due.left -= self._stop(name, number)
            if not due.left:
                del self._due[name][number]
                self.done += 1
                of = (due.parameters, self._frames[name], due.runs)
                yield name, number, trial_of(self._config, *of)
        self._show()

    def _stop(self, name: str, number: int) -> int:
        """Drive a set no more on a sequence; returns along how many segments it is not driven."""
        stopped = 0
        for key in [key for key in self._waiting if self._segments[key[0]].sequence == name]:
            stopped += self._waiting[key].pop(number, None) is not None
            if not self._waiting[key]:
                del self._waiting[key]
        return stopped

    def _share(self, segment: Segment) -> float:
        return len(segment.stamps) / self._frames[segment.sequence].n_driven

    def _save(self, name: str) -> None:
        if name in self._unsaved:
            self._archive.write_frames(name, self._described[name])
            self._unsaved.remove(name)

    @property
    def driven(self) -> float:
        """How many of them are done, with the parts of those that are not."""
        due = sum(due.share for of in self._due.values() for due in of.values())
        return round(self.done + due + sum(self._partly.values()), 6)

    def _show(self) -> None:
        self._progress(self._what, self.driven, self.total, "")


USUAL_COST = 1.4
"""Of a set, over the baseline's, about: 1.1 to 1.6 in the mean of the sets on each of five
recordings."""
ALONE = 2
"""Replays of one set: the baseline and the fixed set."""
FITTING = 10.0
"""Seconds to fit the model, to compare, and to draw the page, about."""
LEFT_BY_BANKS = 0.5
"""Share of the time that is allowed, which replays of banks leave to all else."""


class Forecast(NamedTuple):
    """Seconds, where all workers are at work."""

    each: float  # to try a set on all training sequences
    rest: float  # of the drives that follow: finalists' of whole recordings, and the replays

    def words(self, left: float, most: float) -> str:
        """How long it takes to try so many sets and to finish, in at most so many seconds."""
        rest = self.rest + FITTING
        n, whole = left, self.each * left + rest
        if whole > most:
            n, whole = max(0.0, (most - rest) // max(self.each, 1e-9)), most
        return f"it takes {about(whole)}: {n:.0f} parameter sets of {self.each:.1f} s, and the rest"


def forecast(study: OfflineStudy, archive: Archive, workers: int, clock: Stopwatch) -> Forecast:
    """Tell from the baseline's drives how long the search takes, and what follows it.

    Replays count if they do for the clock. Those of banks leave half of the time to the search:
    sets that were never tried cannot be in a bank.
    """
    baselines = range(len(study.odometry.space.baselines))
    drives = archive.summaries(study.training, baselines)
    costs, each, rest = [], 0.0, 0.0
    for name, trials in drives.items():
        frames = archive.read_frames(name)
        known = [trial.ms if np.isnan(trial.cost) else trial.cost for trial in trials.values()]
        costs.append(1e-3 * float(np.mean(known)))
        each += USUAL_COST * costs[-1] * frames.n_driven * study.config.offline.repeats
        if not archive.is_uncut(name):
            n_sets = len(baselines) + FINALISTS + 2 * OTHERS
            rest += USUAL_COST * costs[-1] * len(frames.stamps) * n_sets
    workers = max(workers, 1)  # those of a cluster may come later
    rest /= workers
    if clock.replays:
        members = study.config.online.switching.size if study.mechanism == "bank" else 0
        scans = sum(study.sequences.open(name).n_messages for name in study.config.test)
        replay = float(np.mean(costs)) * scans
        rest += replay * ALONE
        free = LEFT_BY_BANKS * 3600.0 * (study.config.offline.hours or np.inf) - rest - FITTING
        # A bank that takes longer is not replayed.
        rest += min(replay * len(study.rules) * (members + 1), max(free, 0.0))
    return Forecast(each / workers, rest)


class Campaign:
    """Runs the search of a study, in the time that `expected` says its sets take.

    Once the sets of a portfolio are done, and others follow, `tell` is called with them.
    """

    def __init__(
        self,
        study: OfflineStudy,
        archive: Archive,
        workers: Pool[Any],
        progress: Progress = unseen,
        clock: Stopwatch | None = None,
        expected: Forecast = Forecast(0.0, 0.0),  # noqa: B008 (a tuple)
        tell: Callable[[Mapping[int, JudgedSet]], None] = lambda _: None,
    ):
        self._workers, self._progress, self._expected = workers, progress, expected
        self._config, self._names = study.config.offline, study.training
        self._clock, self._resumed = clock or Stopwatch(study.folder / ELAPSED), 0
        self._begun = self._clock.hours
        self._finished = {name: archive.finished(name) for name in self._names}
        space, known = study.odometry.space, archive.known()
        first, self._tell = study.portfolio, tell
        self._search = Search(self._config, space, self._finished, known, first)
        self._first = range(len(space.baselines) + len(first)) if first else range(0)
        self._schedule = Schedule(study, archive, "runs", self._show)
        self._baselines = range(len(space.baselines))
        self._schedule.most_ms = {
            name: SLOW * max(drive.others.get(REGISTER_MS, np.inf) for drive in drives.values())
            for name, drives in archive.summaries(self._names, self._baselines).items()
            if drives
        }

    def run(self) -> dict[int, JudgedSet]:
        """Run all trials that are not in the archive yet, and judge all of them by number."""
        search = self._search
        self._begin()
        told = search.done.keys() >= {*self._first}
        for name, number, trial in self._schedule.run(self._workers):
            self._schedule.store(name, number, replace(trial, source=search.sources[number]))
            self._clock.save()
            self._begin()
            if not told and search.done.keys() >= {*self._first} and search.end is None:
                told = True
                self._tell({n: search.done[n] for n in self._first})
        self._schedule.close()
        if search.end == TIME_IS_UP:
            # The same command again begins no more.
            self._clock.save(self._config.hours or 0.0)
            if len(search.sets) <= len(self._baselines):
                _log.warning("no other set than the baseline was tried: allow more time")
        _log.info("the search ends: %s", search.end)
        self._show("runs", search.total * len(self._names), 0)
        return dict(sorted(search.done.items()))

    @property
    def words(self) -> list[str]:
        """How many sets were tried, where the time ended the search before all were."""
        if self._search.end != TIME_IS_UP:
            return []
        n, own, of = len(self._search.sets), len(self._baselines), self._config.most_trials
        tried, which = f"{n} of {of}" if of else f"{n}", f"{own} of them" if own < n else "none but"
        return [f"{tried} parameter sets were tried, {which} the odometry's own: {TIME_IS_UP}."]

    def _begin(self) -> None:
        """Begin as many trials as can begin now."""
        while (number := self._search.begin(self._hours)) is not None:
            for name in self._names:
                if number in self._finished[name]:
                    self._schedule.done += 1
                    self._resumed += 1
                else:
                    self._schedule.add(name, number, self._search.sets[number])

    @property
    def _hours(self) -> float:
        """Hours after which all is done, if one more set begins now."""
        now, n, driven = self._clock.hours, len(self._names), self._schedule.driven
        # What was expected counts as much as the first set.
        spent = self._expected.each + 3600.0 * (now - self._begun)
        each = spent / (1.0 + (driven - self._resumed) / n)
        left = (self._schedule.total - driven) / n + 1.0
        # What slows sets down slows down all that follows them.
        left += self._expected.rest / max(self._expected.each, 1e-3)
        return now + (each * left + FITTING) / 3600.0

    def _show(self, what: str, done: float, of: int, remark: str = "", /) -> None:
        search = self._search
        if what == "runs":
            of = search.total * len(self._names)
            if search.done:
                value = search.done[search.best].value
                remark = f"best {label(self._config.objective)} {value:.3f} (trial {search.best})"
        self._progress(what, done, of, remark)


class BaselineError(AdaptuneError):
    """An odometry that fails with its own parameters."""


def labels_of(study: OfflineStudy) -> list[str]:
    """What a study calls its odometries, in the order of their baselines' trials."""
    space = study.odometry.space
    return list(space.spaces) if isinstance(space, PooledSpace) else [study.odometry.name]


def run_baseline(
    study: OfflineStudy, archive: Archive, workers: Pool[Any], progress: Progress
) -> None:
    """Drive the baseline along every training sequence, all of it, unless that was done before.

    Of several odometries, the baseline of each. Nothing is stored before all have done well on all
    sequences: there is a BaselineError if one fails. Where the reference contradicts the motion of
    one, scans say which of them is wrong. Where it moves while the scans stand still, it is left
    out, and the baseline drives again.
    """
    space = study.odometry.space
    there = archive.summaries(study.training, range(len(space.baselines)))
    labels = labels_of(study)
    schedule = Schedule(study, archive, "baseline", progress, kind="whole")
    for name in study.training:
        schedule.need(name)
        for number, parameters in enumerate(space.baselines):
            if number not in there[name]:
                schedule.add(name, number, parameters)
    done: dict[tuple[str, int], Trial] = {}

    def drive() -> None:
        for name, number, trial in checked(schedule, workers, labels):
            done[name, number] = trial

    drive()
    for (name, number), trial in [*done.items()]:
        if _contradicted(study, schedule, name, labels[number], trial):
            for of, other in [key for key in done if key[0] == name]:
                schedule.add(of, other, done[of, other].parameters)
    drive()
    for (name, number), trial in done.items():
        schedule.store(name, number, replace(trial, source="baseline"))
    schedule.close()


def _contradicted(
    study: OfflineStudy, schedule: Schedule, sequence: str, odometry: str, trial: Trial
) -> bool:
    """Tell what scans say against a reference or a baseline; whether segments are left out now."""
    frames, sequences = schedule.frames(sequence), study.sequences
    given = trial.T_odom_sensor, trial.mean_error, None, frames.T_ref_sensor
    for contradiction in (wrong := contradictions_of(sequences, sequence, *given)):
        _log.warning("sequences.%s, %s: %s", sequence, odometry, contradiction)
    if not wrong:
        return False
    lost = left_out(frames.stamps, wrong, begin_of(sequences.open(sequence), frames.stamps))
    if np.isnan(frames.T_ref_sensor[lost]).all():
        return False
    schedule.leave_out(sequence, lost)
    return True


def checked(
    schedule: Schedule, workers: Pool[Any], labels: Sequence[str]
) -> Iterator[tuple[str, int, Trial]]:
    """Run a schedule; a baseline that had a fault, with which all is compared, drives once more."""
    again = set()
    for name, number, trial in schedule.run(workers):
        if number < len(labels):
            if trial.reasons and not trial.failure and (name, number) not in again:
                again.add((name, number))
                what = "sequences.%s: %s has a fault with its own parameters, so once more: %s"
                _log.warning(what, name, labels[number], trial.reasons[-1])
                schedule.add(name, number, trial.parameters)
                continue
            check_baseline(labels[number], name, trial)
        yield name, number, trial


def check_baseline(odometry: str, sequence: str, trial: Trial) -> None:
    """Refuse a baseline that failed, or had a fault, by a BaselineError."""
    if not (trial.failure or trial.reasons):
        return
    said = trial.reasons[-1] if trial.reasons else "it gave no pose, and no reason"
    said = f"{trial.failure}; {said}" if trial.failure else said
    raise BaselineError(
        f"sequences.{sequence}: {odometry} fails with its own parameters, the baseline: "
        f"{said}: mend the odometry (odometry in the study), or leave the sequence out, and run "
        f"the same command again"
    )
