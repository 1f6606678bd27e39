"""Selection while the robot drives: from scans to the parameter set, or the weights, to apply."""

import logging
import threading
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adaptune.bank.members import share
from adaptune.live.evidence import LiveEvidence, spread_of
from adaptune.metrics import FAILURE
from adaptune.model import ErrorModel, ModelError
from adaptune.model.descriptor import Describer, DescriptorError, lowest_elevation
from adaptune.model.registry import ADAPTIVE, STANDBY, call_user_code, rule_class, selected
from adaptune.model.rules import NOVEL_SIMILARITY, Evidence
from adaptune.model.weights import measured_weights, weighted_selection
from adaptune.odometry.base import Motions
from adaptune.recording.scan import Scan
from adaptune.space import (
    IN_DOUBT,
    ODOMETRY,
    ParameterSet,
    ParameterSets,
    ParameterSpace,
    PooledSpace,
    Selection,
)

SCANS_TO_KNOW = 10
"""The sensor is recognised by this many scans that selections are made from."""
SCANS_TO_WARN = 3
"""Before so many there is no warning: the first scan of a drive may be incomplete."""

MAX_TIMES_PREDICTED = 2.0
"""A single odometry leaves a set whose error is surely more than so many times the predicted."""
REMEMBERED = 60.0
"""Seconds for which a failure, or what was measured of that set, counts, and not what is predicted;
and for which members of a bank keep working that would otherwise rest."""
BUDGET_SECONDS = 600.0
"""Over so many seconds, the mean cost of a bank keeps to the user's budget, unless it is lost."""
UNUSUAL = 0.9
"""Quantile of the members' spread in training that counts as usual."""
SETTLING = 2 * 10**9
"""Nanoseconds after a selection for which a failure says nothing of the set."""
SELECTIONS_TO_JUDGE_PLACE = 5
"""A place is new by the median of so many selections: a single one may look odd."""

_log = logging.getLogger(__name__)


class AnySelector(Protocol):
    """What chooses parameters on the way; see `Selector`."""

    def reset(self) -> None:
        """Forget all scans and selections, as before a new recording."""

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See a scan, before it is registered; `stamp` is in nanoseconds.

        The motions are what the odometry, or the bank and its members, moved over the scan before,
        see `adaptune.odometry.base.OdometryInstance`.
        """

    def select(self) -> Selection:
        """Choose what to apply before the newest scan is registered."""

    def measure(self) -> None:
        """Measure how wrong the odometry was, for the next selections."""

    def fall_back(self) -> Selection:
        """What to apply where nothing can be chosen."""


def used_instead(fallen_back: Selection) -> str:
    """What is used where nothing can be chosen, in words."""
    if fallen_back.weights is None:
        return "the fixed set is used"
    return "members that agree are used"


class _Measuring:
    """What selectors of a bank, or of a single odometry, have in common: they measure it."""

    def __init__(
        self,
        sets: ParameterSets,
        fixed: int,
        members: Sequence[int],
        length: float,
        gives_weights: bool,
    ):
        self.fixed, self.members = fixed, tuple(members)
        self._sets, self._gives_weights = sets, gives_weights
        self._always: Sequence[int] = self.members  # those that never rest
        self._usual_spread = -1.0  # of the members in training; any is more where nobody knows it
        self._live = LiveEvidence(self.members, length)

    def reset(self) -> None:
        """Forget all scans and selections, as before a new recording."""
        self._live.reset()

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See `AnySelector.observe`."""
        self._live.observe(stamp, scan, motions)

    def measure(self) -> None:
        """Measure how wrong the odometry, or each member of the bank, was over the last metres.

        It takes some tens of milliseconds, and is done where something is in doubt, else seldom,
        see `LiveEvidence.due`. Nothing depends on when it is called after `select`, and without it
        only the training counts.
        """
        due = self._live.due(self._in_doubt())
        if due or self._live.checking:
            self._live.check()
        if due:
            self._live.measure()

    def _in_doubt(self) -> bool:
        """Whether to measure now: the members differ by more than they do in training."""
        return self._live.spread() > self._usual_spread

    def fall_back(self) -> Selection:
        """What to apply where nothing can be chosen: the fixed set, or what most of a bank do.

        No member of a bank is a better guess than those that agree, see `Agreement`.
        """
        if not self._gives_weights:
            return Selection(self.fixed, self._sets[self.fixed])
        equal = 1.0 / len(self._always)
        weights = {member: equal * (member in self._always) for member in self.members}
        return Selection(self.fixed, self._sets[self.fixed], weights)

    def _weighted(self, weights: NDArray[np.float64]) -> Selection:
        """A selection of the members' weights, shared by those that are present."""
        present = self._live.present()
        if not present.all():
            weights = share(weights, present)
            weights = weights / weights.sum()
        return weighted_selection(
            self._sets, dict(zip(self.members, weights.tolist(), strict=True))
        )

    def _measured(self) -> Selection:
        """A selection of weights by what is measured alone."""
        return self._weighted(measured_weights(len(self.members), self._live.squares()))


class Selector(_Measuring):
    """Chooses parameters for an odometry, or weights for a bank, by an error model.

    Show it every scan with `observe`; ask it to `select` whenever a selection is due, usually once
    a second, and let it `measure` after that: it compares the odometry's motion over the last
    metres, and that of each member of a bank, with a direct registration, see `adaptune.live`. What
    is measured counts from the next selection on. The selector reads no clock and no file.

    With `adaptive`, the selections are weights of the bank's members; with `standby`, the others
    join the fixed set where it is measured to be wrong. A single odometry keeps the fixed set, or
    leaves it for the baseline. ``docs/method.md`` says when, and when
    members rest, and what becomes of scans of another sensor.

    Parameters
    ----------
    model
        Fitted offline.
    rule
        Its name, see `adaptune.model.registry`.
    members
        Trial numbers of the members of the bank that runs, the fixed set first: `adaptive` and
        `standby` weigh them, others choose among them. None takes the model's bank for these two;
        an empty one is for a single odometry.
    descriptors
        Descriptors besides adaptune's own that may be used: a model that names another is refused.

    Attributes
    ----------
    fixed : int
        Trial number of the set to begin with.
    members : tuple of int
        Trial numbers of the bank's members; empty for a single odometry.

    Raises
    ------
    ModelError
        If the model's bank lacks a member, or the model names a descriptor that may not be used.
    DescriptorError
        If a descriptor has changed since the model was fitted.
    """

    def __init__(
        self,
        model: ErrorModel,
        rule: str = ADAPTIVE,
        members: Sequence[int] | None = None,
        descriptors: Collection[str] = (),
    ):
        model.check_descriptors(descriptors)
        cls = rule_class(rule)
        if members is None:
            members = model.bank if cls.gives_weights and len(model.bank) > 1 else ()
        gives_weights = bool(members) and cls.gives_weights
        fixed = members[0] if members else model.fixed
        super().__init__(model.sets, fixed, members, model.length, gives_weights)
        self._model = model
        self._pca = model.pca()
        self._stands_by = rule == STANDBY
        rest = self.members[1:] if self._stands_by else model.reserve
        self._reserve = frozenset(rest if gives_weights else ()).intersection(self.members)
        self._always = [member for member in self.members if member not in self._reserve]
        if gives_weights:
            vectors = model.vectors[:, [model.bank.index(member) for member in self._always]]
            spreads = spread_of(np.where(np.isfinite(vectors), vectors, FAILURE))
            self._usual_spread = float(np.quantile(spreads, UNUSUAL))
        data = model.training_data(self._pca, self.members or None)
        self._rule = call_user_code(cls.of, model.bank_settings if gives_weights else None)
        call_user_code(self._rule.fit, data)
        self._describe = Describer(model.blocks)
        if self._describe.blocks != model.blocks:
            raise DescriptorError(
                f"the model was fitted to descriptors of {model.blocks} numbers, these have "
                f"{self._describe.blocks}; run `adaptune offline` again"
            )
        # The first selection loads compiled code; the robot should not wait for that.
        self.reset()
        self.observe(0, Scan(0, np.zeros((0, 3), np.float32)), Motions(np.eye(4), {}))
        self.select()
        self.reset()

    def reset(self) -> None:
        """Forget all scans and selections, as before a new recording."""
        super().reset()
        self._scan: Scan | None = None
        self._descriptors: deque[NDArray[np.float32]] = deque(maxlen=self._model.window)
        self._current: int | None = None
        self._stamp = self._switched = 0
        self._elevations: list[float] = []
        self._warned = False
        # By trial, the error in percent that was measured of a set that did worse than predicted,
        # and until when it counts, in seconds.
        self._worse: dict[int, tuple[float, float]] = {}
        self._all_work_until = -np.inf  # seconds, before which no member of a bank may rest
        # Seconds of the last selections, and what the members at work cost then.
        self._spent: deque[tuple[float, float]] = deque()
        self._resting: frozenset[int] = frozenset()
        self._similar: deque[float] = deque(maxlen=SELECTIONS_TO_JUDGE_PLACE)
        self._starts: int | None = None
        self._failed = False
        self._predicted = np.nan

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """See `AnySelector.observe`."""
        # The first start comes after the first scan.
        if self._scan is not None:
            self._failed |= self._starts is not None and motions.starts > self._starts
            self._starts = motions.starts
        self._scan, self._stamp = scan, stamp
        super().observe(stamp, scan, motions)

    def select(self) -> Selection:
        """Choose what to apply before the newest scan is registered.

        Raises
        ------
        ValueError
            If no scan was observed.
        DescriptorError
            If the scan cannot be described.
        """
        if self._scan is None:
            raise ValueError("observe a scan before you select")
        self._descriptors.append(self._describe(self._scan))
        mean = np.stack(self._descriptors).mean(axis=0, dtype=np.float64, keepdims=True)
        feature = self._pca.transform(mean.astype(np.float32))[0]
        self._foreign = self._rule.needs_known_sensor and self._is_foreign(self._scan)
        self._resting = frozenset()
        evidence = Evidence(self._worse_than_predicted, self._live.squares, self._at_work)
        selection = selected(self._rule, self._sets, feature, evidence, self.members)
        selection = selection._replace(resting=self._resting)
        self._failed = False
        # Where the fixed set does worse than predicted, training's guess is better than none.
        if self._foreign and self.fixed not in self._worse:
            selection = self._without_training(selection)
        if self.members and selection.weights is None:
            selection = self._of_those_present(selection)
        if selection.weights is not None:
            weights = np.array([selection.weights[member] for member in self.members])
            trial, parameters, shared, *_ = self._weighted(weights)
            selection = selection._replace(trial=trial, parameters=parameters, weights=shared)
        elif selection.trial != self._current:
            self._live.forget()  # the hops were those of another set
            self._switched = self._stamp
        self._current, self._predicted = selection.trial, selection.predicted_error
        return self._live.estimated(selection)

    def _at_work(
        self, members: Sequence[int], similarity: float, predicted: float
    ) -> Sequence[int]:
        """See `Evidence.at_work`."""
        self._similar.append(0.0 if self._foreign else similarity)
        if not self._reserve:
            return members
        # Somebody has to go on.
        present = self._live.present()[np.isin(self.members, self._always)].any()
        if (self._is_enough(predicted) or not self._can_pay()) and present:
            self._resting = self._reserve
        at_work = [member for member in members if member not in self._resting]
        if (costs := self._model.costs) is not None and self._model.milliseconds is not None:
            now = self._stamp * 1e-9
            self._spent.append((now, costs.adaptive(at_work)))
            while self._spent[0][0] <= now - BUDGET_SECONDS:
                self._spent.popleft()
        return at_work

    def _can_pay(self) -> bool:
        """Whether all may work: within the budget in the mean, or because the bank is lost."""
        budget, costs = self._model.milliseconds, self._model.costs
        if budget is None or costs is None or self._failed or self._live.health.state == "lost":
            return True
        spent = [cost for _, cost in self._spent]
        return float(np.mean([*spent, costs.adaptive(self.members)])) <= budget

    def _is_new(self) -> bool:
        """Whether training does not know the place."""
        return bool(self._similar) and float(np.median(self._similar)) < NOVEL_SIMILARITY

    def _in_doubt(self) -> bool:
        """Whether a bank at work is in a new place, or differs by more than in training."""
        at_work = self._gives_weights and self._resting != frozenset(self.members[1:])
        return at_work and (self._is_new() or super()._in_doubt())

    def _is_enough(self, predicted: float) -> bool:
        """Whether the members that always work are enough.

        Training knows the place, they do as predicted, and have not failed in the last minute.
        """
        seconds = self._stamp * 1e-9
        error = self._live.own_error()
        is_worse = error is not None and error.low > MAX_TIMES_PREDICTED * predicted
        # A fixed set is not left because a place is new alone.
        is_new = not self._stands_by and self._is_new()
        if is_new or is_worse or self._failed or self._live.health.state in IN_DOUBT:
            self._all_work_until = seconds + REMEMBERED
        return seconds >= self._all_work_until

    def _worse_than_predicted(self) -> Mapping[int, float]:
        """By trial, what was measured of sets that have done worse than predicted, in percent."""
        seconds = self._stamp * 1e-9
        self._worse = {t: worse for t, worse in self._worse.items() if worse[1] > seconds}
        error = self._live.own_error()
        current = self._current
        if current is not None:
            # One that has just been selected may have begun with an odometry that was lost.
            if self._failed and self._stamp - self._switched > SETTLING:
                self._worse[current] = FAILURE, seconds + REMEMBERED
            elif error is not None and error.low > MAX_TIMES_PREDICTED * self._predicted:
                self._worse[current] = error.mean, seconds + REMEMBERED
        return {trial: error for trial, (error, _) in self._worse.items()}

    def _of_those_present(self, selection: Selection) -> Selection:
        """Replace a member that gives no poses by the first one that does."""
        present = self._live.present()
        if selection.trial not in self.members:
            name, members = type(self._rule).__name__, ", ".join(map(str, self.members))
            raise ModelError(
                f"{name}: selects trial {selection.trial}, which is not in the bank (trials "
                f"{members}); choose among data.candidates"
            )
        if present[self.members.index(selection.trial)]:
            return selection
        trial = self.members[int(present.argmax())]
        return selection._replace(trial=trial, parameters=self._sets[trial])

    def _without_training(self, selection: Selection) -> Selection:
        """What to do where the training says nothing."""
        return selection._replace(
            trial=self.fixed,
            parameters=self._sets[self.fixed],
            weights=selection.weights and self._measured().weights,
            predicted_error=selection.predicted_fixed,
            similarity=0.0,
        )

    def _is_foreign(self, scan: Scan) -> bool:
        """Whether the scans seen so far come from a sensor that was not trained with."""
        if len(scan) and len(self._elevations) < SCANS_TO_KNOW:
            self._elevations.append(lowest_elevation(scan))
        if not self._elevations:
            return False
        foreign = [self._model.is_foreign(elevation) for elevation in self._elevations]
        if 2 * sum(foreign) <= len(foreign):
            return False
        if not self._warned and len(foreign) >= SCANS_TO_WARN:
            self._warned = True
            known = sorted({f"{elevation:.0f}" for elevation in self._model.elevations})
            _log.warning(
                "the scans' lowest points lie at %.0f degrees, those of training at %s: this is "
                "another sensor or mount, of which the training says nothing",
                np.median(self._elevations),
                ", ".join(known),
            )
        return True


# A selector in a loop that must not stop: one call a scan, and a selection when one is due.


BACK = 10**9
"""Nanoseconds. Stamps that go back by more are of another drive: a clock was set, or a bag began
anew."""


class Periods:
    """Says when a selection is due: at the first scan, and at the first of every further period.

    The period is in the unit of what `due` is asked, such as nanoseconds.
    """

    def __init__(self, period: float):
        self._period = period
        self.reset()

    def reset(self) -> None:
        """Begin anew."""
        self._first: float | None = None
        self._n_periods = 0

    def due(self, now: float) -> bool:
        """Whether to select; `now` rises from call to call."""
        if self._first is None:
            self._first = now
        since = now - self._first
        if since < self._n_periods * self._period:
            return False
        self._n_periods = int(since // self._period) + 1
        return True


class TimedSelector:
    """Selects once a period, and never raises nor reads a file or a clock.

    Call `update` with every scan, from any thread. What goes wrong costs a selection and not the
    drive: the odometry then gets what `fall_back` says, once, and the next period begins anew.

    Parameters
    ----------
    selector
        Nothing else may use it.
    period
        Seconds between selections, by the scans' stamps.
    """

    def __init__(self, selector: AnySelector, period: float = 1.0):
        if not period > 0:
            raise ValueError("the period must be above 0")
        self._selector = selector
        self._periods = Periods(period * 1e9)
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self._selector.reset()
        self._periods.reset()
        self._stamp: int | None = None
        self._unmeasured = self._failing = False
        self._owed: Selection | None = None  # for the next update to return

    def update(self, stamp: int, scan: Scan, motions: Motions) -> Selection | None:
        """See a scan, before it is registered, and select if that is due.

        A selection takes some milliseconds. After each, `measure` takes some tens of milliseconds;
        the next update does that first if nobody has done it.

        Scans that are not newer than the one before are ignored; if the stamp, in nanoseconds, goes
        back by more than `BACK`, all is forgotten as before another drive. For the motions see
        `AnySelector.observe`. Returns what to apply before the scan is registered; None to leave
        the odometry as it is.
        """
        with self._lock:
            if self._stamp is not None and stamp <= self._stamp:
                if self._stamp - stamp <= BACK:
                    return None
                _log.warning(
                    "the clock went back by %.1f s: the selector begins anew",
                    (self._stamp - stamp) * 1e-9,
                )
                self._begin()
            self._stamp = stamp
            if (owed := self._owed) is not None:
                self._owed = None
                return owed
            try:
                return self._selected(stamp, scan, motions)
            except Exception:
                return self._after_failure()

    def measure(self) -> None:
        """Measure how wrong the odometry was, for the next selections; else the next update does.

        Nothing is measured twice.
        """
        with self._lock:
            try:
                self._measure()
            except Exception:
                self._owed = self._after_failure()

    def _measure(self) -> None:
        if self._unmeasured:
            self._unmeasured = False
            self._selector.measure()

    def _selected(self, stamp: int, scan: Scan, motions: Motions) -> Selection | None:
        self._measure()
        self._selector.observe(stamp, scan, motions)
        if not self._periods.due(stamp):
            return None
        selection = self._selector.select()
        self._unmeasured, self._failing = True, False
        return selection

    def _after_failure(self) -> Selection | None:
        """What to fall back to, unless the odometry has it since the last failure."""
        self._unmeasured = False
        self._selector.reset()
        if self._failing:
            return None
        self._failing = True
        fallen_back = self._selector.fall_back()
        _log.exception("no parameters can be selected; %s", used_instead(fallen_back))
        return fallen_back


# A bank without a model: parameter sets that nobody has tried, and weights for them.


CANDIDATES = 16
"""Sets that the members of a bank are chosen from; a power of two, as Sobol's points want it."""


def untrained_sets(
    space: ParameterSpace, n: int = 4, portfolio: Sequence[ParameterSet] = ()
) -> ParameterSets:
    """The baseline, and the first set of a portfolio, numbered from 0.

    A second one costs more, and gained nothing sure. Without a portfolio, they are sets around the
    baseline that are far from each other. Of several odometries, the baselines of all come first,
    then sets of the first one. The candidates are points of a scrambled Sobol sequence, moved
    half-way to the baseline: what the odometry's authors chose is the best guess there is. Each
    next set is the one that is farthest from those chosen before. There are fewer than `n` if the
    candidates are equal.
    """
    chosen = space.baselines[:n]
    if portfolio:
        chosen = [*chosen, portfolio[0]][:n]
    elif isinstance(space, PooledSpace):
        first = next(iter(space.spaces.items()))
        around = untrained_sets(first[1], n - len(chosen) + 1).parameters[1:]
        chosen += [{ODOMETRY: first[0], **own} for own in around]
    elif len(space):
        from scipy.stats import qmc  # slow to import

        sobol = qmc.Sobol(len(space), rng=np.random.default_rng(0))
        centre = space.to_unit(chosen)
        candidates = space.from_unit(0.5 * (centre + sobol.random(CANDIDATES)))
        # Rounded, so that sets are apart by what they are, not by what they were drawn as.
        unit = space.to_unit(candidates)
        distance = np.linalg.norm(unit - centre, axis=1)
        while len(chosen) < n and distance.max() > 0.0:
            farthest = int(distance.argmax())
            chosen.append(candidates[farthest])
            distance = np.minimum(distance, np.linalg.norm(unit - unit[farthest], axis=1))
    return ParameterSets(space, tuple(range(len(chosen))), tuple(chosen))


class UntrainedSelector(_Measuring):
    """Weighs the members of a bank of which nothing is known in advance.

    It needs no model. The baseline, which is the first of the sets (see `untrained_sets`), has all
    the weight until live evidence confirms other members. An estimated error stands for a
    sub-trajectory of `length` metres. Attributes are those of `Selector`.
    """

    def __init__(self, sets: ParameterSets, length: float):
        super().__init__(sets, sets.trials[0], sets.trials, length, True)
        self._always = sets.trials[:1]  # nobody knows the others

    def select(self) -> Selection:
        """Choose the weights to apply before the newest scan is registered."""
        return self._live.estimated(self._measured())
