"""The modes of a replay: what each one runs, and what chooses its parameters."""

import logging
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from adaptune._system import manifest
from adaptune._system.machine import available, pin, release_memory
from adaptune._system.progress import Progress, unseen
from adaptune.bank.bank import Bank
from adaptune.errors import AdaptuneError, Finding, OdometryError
from adaptune.model import ErrorModel
from adaptune.model.descriptor import DescriptorError
from adaptune.model.registry import ADAPTIVE, ENTRY_POINTS, RULES, STANDBY
from adaptune.model.weights import weighted_selection
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.content import python_content
from adaptune.odometry.factory import Factory, OdometryFactory
from adaptune.odometry.registry import ROS_SYSTEMS
from adaptune.recording.config import part_name
from adaptune.recording.scan import Recording, Scan
from adaptune.reference.carried import begin_of, without
from adaptune.reference.check import mean_difference
from adaptune.runs.files import StoredReplayError, is_complete, read_run, write_run
from adaptune.runs.loop import replay
from adaptune.runs.record import Run
from adaptune.selector import AnySelector, Selector, UntrainedSelector, untrained_sets
from adaptune.space import ParameterSet, ParameterSets, Selection
from adaptune.study.config import ALSO, StudyConfig
from adaptune.study.driven import ModeError, bank_members, mechanism_of, no_bank
from adaptune.study.references import contradictions_of, ensure_references
from adaptune.study.study import Mechanism, Study
from adaptune.trajectory import Trajectory
from online.real_time import replay_in_real_time
from online.reference import CONTRADICTIONS, reference_folder, write_reference
from online.selector_process import SelectorProcess

BASELINE, FIXED, EVEN, UNTRAINED = "baseline", "fixed", "even", "untrained"
MODES = tuple(dict.fromkeys((BASELINE, FIXED, ADAPTIVE, STANDBY, UNTRAINED, EVEN, *RULES)))
"""All modes but rules of the user's, in the order of tables and of lines that lie on each other."""
WITHOUT_MODEL: tuple[str, ...] = (BASELINE, UNTRAINED)
"""The modes that need neither trials nor a model."""
ONE_CORE = 50.0
"""Milliseconds of CPU time a scan up to which a bank runs on one core: of several, each prepares
every scan again. Most sensors give a scan every 100 ms."""
_log = logging.getLogger(__name__)


class EvenSelector:
    """Gives all members of a bank the same weight, always: a control, which looks at nothing.

    `members` are trial numbers among the `sets`; see `adaptune.selector.AnySelector`.
    """

    def __init__(self, sets: ParameterSets, members: Sequence[int]):
        even = dict.fromkeys(members, 1.0 / len(members))
        self._selection = weighted_selection(sets, even)

    def reset(self) -> None:
        """Nothing is remembered."""

    def observe(self, stamp: int, scan: Scan, motions: Motions) -> None:
        """Nothing depends on a scan."""

    def measure(self) -> None:
        """Nothing is measured."""

    def select(self) -> Selection:
        """Even weights."""
        return self._selection

    fall_back = select


class Mode(NamedTuple):
    """What runs along a recording, and what chooses its parameters, if anything does."""

    name: str
    sets: Mapping[int, ParameterSet]  # by trial: a bank's members, or the one set to begin with
    bank: bool = False
    selector: Callable[[], AnySelector] | None = None  # makes it; pickles
    cost: float = math.nan  # of a bank, milliseconds of CPU time a scan in training, if known

    @property
    def live(self) -> bool:
        """Whether one instance changes its parameters while it runs."""
        return self.selector is not None and not self.bank

    @property
    def fixed(self) -> int:
        """Trial number of the set that it begins with."""
        return next(iter(self.sets))


@dataclass(frozen=True)
class ReplaySetup:
    """What a replay depends on, besides the recording and the model."""

    config: StudyConfig
    odometry: Factory
    mechanism: Mechanism | None  # how the odometry changes its parameters
    rules: tuple[str, ...]  # selection rules to compare
    also: tuple[str, ...] = ()  # modes on demand, see `OnlineConfig`
    portfolio: tuple[ParameterSet, ...] = ()  # sets that are known to do well in some places
    model: ErrorModel | None = None  # what modes select with

    @classmethod
    def of(cls, study: Study, model: ErrorModel | None = None) -> Self:
        """The setup of a study."""
        also = study.config.online.also
        of = (study.config, study.odometry, study.mechanism, study.rules)
        return cls(*of, also, study.portfolio, model)

    def mode(self, name: str) -> Mode:
        """What a mode runs.

        Raises
        ------
        ModeError
            If it is not possible, if the model is lacking, or does not go with the study's bank.
        """
        if name == BASELINE:
            return Mode(name, {0: self.odometry.space.baseline})
        if why := self.obstacle(name):
            raise ModeError(f"{name} is not possible: {why}")
        if name == UNTRAINED:
            sets = self._untrained_sets()
            members = dict(zip(sets.trials, sets.parameters, strict=True))
            untrained = partial(UntrainedSelector, sets, self.config.sub_trajectory)
            return Mode(name, members, True, untrained)
        model = needed(name, self.model)
        if name == FIXED:
            return Mode(name, {model.fixed: model.sets[model.fixed]})
        if name == EVEN:
            members = self._always(model)
            even = partial(EvenSelector, model.sets, list(members))
            return Mode(name, members, True, even, _cost(model, members))
        descriptors = self.config.descriptor
        if self._mechanism(name, model) == "live":
            fixed = {model.fixed: model.sets[model.fixed]}
            return Mode(name, fixed, False, partial(Selector, model, name, (), descriptors))
        # The bank's reserve joins in by what is measured: only these modes have one.
        joins = name in (ADAPTIVE, STANDBY)
        members = self._members(model) if joins else self._always(model)
        make = partial(Selector, model, name, list(members), descriptors)
        # The reserve rests nearly always.
        return Mode(name, members, True, make, _cost(model, self._always(model)))

    def obstacle(self, name: str) -> str:
        """Why a mode is not possible; empty if it is, as far as is known without a model."""
        if name in (BASELINE, FIXED):
            return ""
        if self.odometry.description.whole:
            return "a program that runs whole recordings cannot change its parameters"
        model = self.model
        if name == UNTRAINED:
            differ = len(self._untrained_sets()) > 1
            why = "no parameters by which the members of a bank would differ (odometry.parameters)"
            return "" if differ else f"{self.odometry.name} has {why}"
        if name == EVEN and model is not None:
            alone = len(model.bank) < 2
            return "the model's bank has no other member than the fixed set" if alone else ""
        if model is not None and self._mechanism(name, model) is None:
            return no_bank(self.mechanism, self.odometry, model)
        return ""

    @property
    def modes(self) -> tuple[str, ...]:
        """What is replayed, in the order of `MODES`: what is possible of all modes.

        Without the model, all is possible that is with any.
        """
        modes = {BASELINE, FIXED, *self.rules, *self.also}
        modes |= set() if self.model is None else {self.model.recommended}
        return in_order(name for name in modes if not self.obstacle(name))

    def default(self, steered: bool = False) -> str:
        """The mode that a robot drives: what is recommended; of a single set, with a stand-by."""
        recommended = None if self.model is None else self.model.recommended
        if recommended == ADAPTIVE and not steered and not self.obstacle(ADAPTIVE):
            return ADAPTIVE
        return STANDBY if steered or not self.obstacle(STANDBY) else FIXED

    def instance(self, mode: Mode, sequence: str | None = None) -> OdometryInstance:
        """Make the odometry of a mode, or the bank.

        Programs that run whole recordings need the name of the `sequence`.
        """
        if not mode.bank:
            return self.odometry(mode.sets[mode.fixed], sequence)
        in_time = self.config.online.real_time
        # Where no scan is dropped, no member is left behind either.
        rate = in_time.rate if in_time is not None and in_time.queue else None
        pace = 1.0 if in_time is None else in_time.rate
        cores = 1 if mode.cost * pace <= ONE_CORE else available()
        return Bank(self.odometry, mode.sets, self.config.lost_track, cores, rate)

    def identity(self, name: str) -> dict[str, Any]:
        """What a mode depends on, as plain data."""
        mode, keys = self.mode(name), ("parameters", "mode", "period", "model", "switching")
        about: dict[str, Any] = dict.fromkeys(keys)
        if mode.selector is None:  # no matter what the set is called
            return about | {"parameters": mode.sets[mode.fixed]}
        about |= {"mode": name, "period": self.config.online.period}
        if mode.bank:
            # A model's sets are known by their numbers.
            members = [*(mode.sets.values() if name == UNTRAINED else mode.sets)]
            about["switching"] = {"mechanism": "bank", "members": members}
        else:
            about["switching"] = {"mechanism": "live"} | self.odometry.steering
        if name != UNTRAINED:
            about["model"] = self._digest
        return about if name in MODES else about | {"rule": python_content(name, ENTRY_POINTS)}

    @cached_property
    def _digest(self) -> str | None:
        return None if self.model is None else self.model.digest

    def check(self, path: Path) -> None:
        """Refuse a model for another bank, or with a descriptor of somebody else's, from `path`."""
        model = needed(str(path), self.model)
        model.check_descriptors(self.config.descriptor, path)
        online = self.config.online
        if model.budget != online.budget:
            raise ModeError(
                f"online.budget: {path} was fitted for another one; run `adaptune offline` "
                f"again, which fits it to the finished trials"
            )
        if self.mechanism == "bank" or (EVEN in self.also and not self.obstacle(EVEN)):
            self._members(model)

    def _mechanism(self, name: str, model: ErrorModel) -> Mechanism | None:
        return mechanism_of(name, model, self.mechanism, self.odometry.description.live)

    def _members(self, model: ErrorModel) -> dict[int, ParameterSet]:
        return bank_members(self.config.online.switching, model)

    def _always(self, model: ErrorModel) -> dict[int, ParameterSet]:
        """The bank's members without its reserve, which joins in by what is measured."""
        reserve = model.bank[len(model.bank) - model.bank_settings.reserve :]
        return {trial: s for trial, s in self._members(model).items() if trial not in reserve}

    def _untrained_sets(self) -> ParameterSets:
        n = self.config.online.switching.size
        return untrained_sets(self.odometry.space, n, self.portfolio)


def _cost(model: ErrorModel, members: Iterable[int]) -> float:
    return math.nan if model.costs is None else model.costs.adaptive(members)


def needed(name: str, model: ErrorModel | None) -> ErrorModel:
    """The model of a mode that cannot do without; a ModeError if there is none."""
    if model is None:
        raise ModeError(f"{name}: needs an error model; run `adaptune offline`, which fits one")
    return model


def in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Names of modes in the order of `MODES`, and then those of the user's."""
    there = sorted(names)
    return tuple(dict.fromkeys((*(mode for mode in MODES if mode in there), *there)))


class Replays:
    """The replays of a study with an error model, if there is one.

    Each is in a folder whose name ends with the digest of all that it is made from. So what differs
    is another one, and none is made twice, whatever the mode is called.
    """

    def __init__(self, study: Study, model: ErrorModel | None = None):
        self.study, self.model, self.setup = study, model, ReplaySetup.of(study, model)
        self._shared = cache(study.replay_inputs)

    @classmethod
    def of(cls, study: Study) -> Self:
        """Those with the study's own model."""
        some = study.model_file is not None or study.model_path.exists()
        return cls(study, study.model() if some else None)

    def inputs(self, name: str, mode: str) -> dict[str, Any]:
        """All that a replay of a sequence is made from, as plain data."""
        return dict(manifest.plain(self._shared(name) | self.setup.identity(mode)))

    def folder(self, name: str, mode: str) -> Path:
        """Where a replay is, or will be."""
        digest = manifest.digest(self.inputs(name, mode))[: manifest.SHORT]
        folder = self.study.folder / "replays" / name
        return next(folder.glob(f"*-{digest}"), folder / f"{mode}-{digest}")

    def read(self, name: str, mode: str) -> Run:
        """Read a replay; a StoredReplayError says that it is missing or damaged."""
        folder = self.folder(name, mode)
        if not (folder / "replay.json").exists():
            why = self.changes(name, mode)
            what = f"{mode} was made from other inputs: {why}" if why else f"there is no {mode}"
            raise StoredReplayError(f"{folder.parent}: {what}; run `adaptune online` first")
        return read_run(folder)

    def made(self, name: str) -> tuple[str, ...]:
        """The modes in which a sequence was replayed, see `in_order`."""
        if not (self.study.folder / "replays" / name).exists():
            return ()
        setup = replace(self.setup, also=ALSO)
        possible = [m for m in setup.modes if self.model is not None or m in WITHOUT_MODEL]
        return tuple(m for m in possible if (self.folder(name, m) / "replay.json").exists())

    def changes(self, name: str, mode: str) -> str:
        """In what the last replay differs from one that would be made now; empty without one."""
        made = (self.study.folder / "replays" / name).glob(f"{mode}-*/replay.json")
        last = max(made, key=lambda path: path.stat().st_mtime, default=None)
        if last is None:
            return ""
        before, now = manifest.recorded(last.with_name(manifest.FILE)), self.inputs(name, mode)
        return "; ".join(manifest.changes(before, now, self.study.sequences.sources(name)))


def sequences_without_model(config: StudyConfig) -> tuple[str, ...]:
    """The sequences to replay without a model: those of the test, or if it names none, all.

    A recording of which `training` names parts is replayed as a whole.
    """
    if config.test:
        return config.test
    recorded = {name: entry.part for name, entry in config.sequences.items()}
    parts = recorded | {name: course.part for name, course in config.courses.items()}

    def is_part(name: str) -> bool:
        part = parts[name]
        whole = name if part is None else name.removesuffix(part_name("", part))
        return whole != name and whole in parts

    return tuple(name for name in parts if not is_part(name))


def run_replays(study: Study, model_path: Path, progress: Progress = unseen) -> int:
    """Replay every test sequence in every mode, unless that was done before.

    ``replays/<sequence>/<mode>-<digest>`` in the study's folder receives the results. Returned is
    the number of replays that were made.

    Raises
    ------
    AdaptuneError
        If there is no test sequence, the model is of another odometry, other parameters or other
        sub-trajectories, or what the study's own model was fitted to has changed.
    """
    model = study.model(model_path)
    setup = ReplaySetup.of(study, model)
    setup.check(model_path)
    if not study.config.test:
        raise AdaptuneError("test: name at least one sequence to replay")
    obstacles = {name: setup.obstacle(name) for name in study.config.online.modes}
    for why in dict.fromkeys(filter(None, obstacles.values())):
        names = " and ".join(name for name, obstacle in obstacles.items() if obstacle == why)
        _log.warning("not replayed: %s, because %s", names, why)
    return replay_modes(study, study.config.test, setup.modes, progress, model)


def run_untrained(study: Study, progress: Progress = unseen) -> int:
    """Replay `sequences_without_model` with the baseline, and with a bank that needs no model.

    Neither trials nor references are needed. For the rest see `run_replays`.

    Raises
    ------
    AdaptuneError
        If a bank of the odometry is not possible.
    """
    ReplaySetup.of(study).mode(UNTRAINED)  # or an error
    names = sequences_without_model(study.config)
    return replay_modes(study, names, WITHOUT_MODEL, progress)


def replay_modes(
    study: Study,
    sequences: Sequence[str],
    modes: Sequence[str],
    progress: Progress,
    model: ErrorModel | None = None,
) -> int:
    """Replay what was not replayed before; the number of replays that were made.

    Sequences without a reference get an estimated one before, where that is possible. They are
    judged by it, and it by the first mode. Baseline alone needs no error model.
    """
    study.open()
    length = study.config.sub_trajectory
    refused = ensure_references(study.sequences, sequences, length, progress, required=False)
    for why in refused.values():
        _log.warning("%s; it is replayed without a reference, and not judged", why)
    in_vain = cache(lambda: _in_vain(study.odometry, study.sequences.open(sequences[0])))
    replays, made = Replays(study, model), 0
    with pin(os.getpid(), alone=True):  # the estimates had all cores
        for name in sequences:
            for number, mode_name in enumerate(modes):
                folder = replays.folder(name, mode_name)
                if not is_complete(folder):
                    mode = replays.setup.mode(mode_name)
                    if mode.live and (why := in_vain()):
                        _log.warning("%s is not replayed on %s: %s", mode_name, name, why)
                        continue
                    if why := replays.changes(name, mode_name):
                        _log.info("%s, %s: replayed again: %s", name, mode_name, why)
                    _replay(replays, name, mode, folder, progress)
                    made += 1
                if number == 0 and not (reference_folder(study, name) / CONTRADICTIONS).exists():
                    _write_judged_reference(study, name, read_run(folder).trajectory)
    return made


def _in_vain(odometry: Factory, recording: Recording) -> str:
    """Why a ROS system cannot adapt live: it accepts parameters, and does not read them again."""
    if not isinstance(odometry, OdometryFactory) or odometry.name not in ROS_SYSTEMS:
        return ""
    from adaptune.odometry.systems.probe import check_live  # little else needs it

    try:
        check_live(odometry, recording)
    except OdometryError as error:
        return str(error)
    return ""


def _write_judged_reference(study: Study, name: str, replayed: Trajectory) -> None:
    """Write the reference of a sequence, and what scans say where a replay disagrees with it."""
    recording, sequences = study.sequences.open(name), study.sequences
    reference, wrong = recording.reference(), list[Finding]()
    if reference is not None:
        T_ref_sensor, T_odom_sensor = reference.at(replayed.stamps), replayed.T_world_sensor
        error = mean_difference(T_ref_sensor, T_odom_sensor, study.config.sub_trajectory)
        seen = set(replayed.stamps.tolist())
        wrong = contradictions_of(sequences, name, T_odom_sensor, error, seen, T_ref_sensor)
        reference = without(reference, wrong, begin_of(recording, replayed.stamps))
    for what in wrong:
        _log.warning("sequences.%s: %s", name, what)
    write_reference(reference_folder(study, name), reference, replayed, wrong)


def _replay(replays: Replays, name: str, mode: Mode, folder: Path, progress: Progress) -> None:
    """Make a replay, and store it in a folder."""
    study, what = replays.study, f"{name}, {mode.name}"
    recording = study.sequences.open(name)
    if study.odometry.description.whole:
        study.sequences.program_input(name)  # may be written, which costs no mode
    release_memory()
    instance = partial(replays.setup.instance, mode, name)
    try:
        run = run_mode(study, recording, instance, mode, what, progress)
    except DescriptorError as error:
        raise AdaptuneError(f"sequences.{name}: {error}") from error
    write_run(folder, run, replays.inputs(name, mode.name))


def run_mode(
    study: Study,
    recording: Recording,
    instance: Callable[[], OdometryInstance],
    mode: Mode,
    what: str,
    progress: Progress,
    again: bool = False,
) -> Run:
    """Replay; the baseline, with which all is compared, once more `again` where it had a fault."""
    online, make, n = study.config.online, mode.selector, recording.n_messages

    def watch(run: Run) -> None:
        progress(what, run.done, n)

    with ExitStack() as stack:
        odometry = stack.enter_context(closing(instance()))
        given = recording, odometry, study.config.health
        if online.real_time is None:
            selector = make and make()
            fallback = None if selector is None else selector.fall_back()
            run = replay(*given, selector, online.period, watch, what, fallback)
        else:
            process = make and stack.enter_context(closing(SelectorProcess(make, online.period)))
            run = replay_in_real_time(*given, online.real_time, process, watch, what)
    progress(what, n, n)
    if mode.name != BASELINE or not run.faults:
        return run
    wrong = f"{what}: a fault with the odometry's own parameters: {run.faults[-1]}"
    if again:
        raise AdaptuneError(f"{wrong}; mend the odometry, or leave the sequence out of the test")
    _log.warning("%s; so once more", wrong)
    return run_mode(study, recording, instance, mode, what, progress, again=True)
