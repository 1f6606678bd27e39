"""The modes of a replay: what each one runs, and what chooses its parameters."""

import logging
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from adaptune import manifest
from adaptune.bank.bank import WARM_UP, Bank
from adaptune.errors import AdaptuneError, Finding, OdometryError
from adaptune.machine import available, pin, release_memory
from adaptune.model import ErrorModel
from adaptune.model.descriptor import DescriptorError
from adaptune.model.registry import ADAPTIVE, ENTRY_POINTS, RULES, STANDBY
from adaptune.model.weights import weighted_selection
from adaptune.odometry.base import Motions, OdometryInstance
from adaptune.odometry.content import python_content
from adaptune.odometry.factory import Factory, OdometryFactory
from adaptune.odometry.registry import ROS_SYSTEMS
from adaptune.progress import Progress, unseen
from adaptune.recording.config import part_name
from adaptune.recording.scan import Recording, Scan
from adaptune.reference.carried import begin_of, without
from adaptune.reference.check import mean_difference
from adaptune.selector import AnySelector, Selector, UntrainedSelector, untrained_sets
from adaptune.space import ParameterSet, ParameterSets, Selection
from adaptune.study.config import StudyConfig
from adaptune.study.driven import ModeError, bank_members, mechanism_of, no_bank
from adaptune.study.references import contradictions_of, ensure_references
from adaptune.study.study import Mechanism, Study
from adaptune.trajectory import Trajectory
from online.real_time import replay_in_real_time
from online.record import StoredReplay, replay_changes, write_replay
from online.reference import is_reference_of, write_reference
from online.replay import ReplayRecord, replay
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

    @classmethod
    def of(cls, study: Study) -> Self:
        """The setup of a study."""
        also = study.config.online.also
        of = (study.config, study.odometry, study.mechanism, study.rules)
        return cls(*of, also, study.portfolio)

    def mode(self, name: str, model: ErrorModel | None = None) -> Mode:
        """What a mode runs.

        Raises
        ------
        ModeError
            If it is not possible, if the model is lacking, or does not go with the study's bank.
        """
        if name == BASELINE:
            return Mode(name, {0: self.odometry.space.baseline})
        if why := self.obstacle(name, model):
            raise ModeError(f"{name} is not possible: {why}")
        if name == UNTRAINED:
            sets = self._untrained_sets()
            members = dict(zip(sets.trials, sets.parameters, strict=True))
            untrained = partial(UntrainedSelector, sets, self.config.sub_trajectory)
            return Mode(name, members, True, untrained)
        model = needed(name, model)
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
        return Mode(name, members, True, make, _cost(model, members))

    def obstacle(self, name: str, model: ErrorModel | None = None) -> str:
        """Why a mode is not possible; empty if it is, as far as is known without a model."""
        if name in (BASELINE, FIXED):
            return ""
        if self.odometry.description.whole:
            return "a program that runs whole recordings cannot change its parameters"
        if name == UNTRAINED:
            differ = len(self._untrained_sets()) > 1
            why = "no parameters by which the members of a bank would differ (odometry.parameters)"
            return "" if differ else f"{self.odometry.name} has {why}"
        if name == EVEN and model is not None:
            alone = len(model.bank) < 2
            return "the model's bank has no other member than the fixed set" if alone else ""
        if model is not None and self._mechanism(name, model) is None:
            return no_bank(self.mechanism, self.odometry)
        return ""

    def modes(self, model: ErrorModel | None) -> tuple[str, ...]:
        """What is replayed with a model, in the order of `MODES`: what is possible of all modes.

        Without the model, all is possible that is with any.
        """
        modes = {BASELINE, FIXED, *self.rules, *self.also}
        modes |= set() if model is None else {model.recommended}
        return in_order(name for name in modes if not self.obstacle(name, model))

    def default(self, model: ErrorModel, steered: bool = False) -> str:
        """The mode that a robot drives: what is recommended; of a single set, with a stand-by."""
        if model.recommended == ADAPTIVE and not steered and not self.obstacle(ADAPTIVE, model):
            return ADAPTIVE
        return STANDBY if steered or not self.obstacle(STANDBY, model) else FIXED

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
        return Bank(self.odometry, mode.sets, WARM_UP, self.config.lost_track, cores, rate)

    def identity(
        self, name: str, model: ErrorModel | None = None, digest: str = ""
    ) -> dict[str, Any]:
        """What a mode depends on, as plain data; `digest` is the model's."""
        about: dict[str, Any] = dict.fromkeys(("parameters", "model", "switching"))
        about["mode"] = name
        if name in (BASELINE, FIXED):
            mode = self.mode(name, model)
            return about | {"parameters": mode.sets[mode.fixed]}
        switching: dict[str, Any] = {"mechanism": "bank", "warm_up": WARM_UP}
        if name == UNTRAINED:
            members = list(self._untrained_sets().parameters)
            return about | {"switching": switching | {"members": members}}
        if name not in MODES:
            about |= {"rule": python_content(name, ENTRY_POINTS)}
        if name != EVEN and self._mechanism(name, needed(name, model)) != "bank":
            live = {"mechanism": "live"} | self.odometry.steering
            return about | {"model": digest, "switching": live}
        named = self.config.online.switching.model_dump(mode="json", include={"size", "sets"})
        return about | {"model": digest, "switching": switching | named}

    def check(self, model: ErrorModel, path: Path) -> None:
        """Refuse a model for another bank, or with a descriptor of somebody else's, from `path`."""
        model.check_descriptors(self.config.descriptor, path)
        online = self.config.online
        if model.budget != online.budget:
            raise ModeError(
                f"online.budget: {path} was fitted for another one; run `adaptune offline` "
                f"again, which fits it to the finished trials"
            )
        if self.mechanism == "bank" or (EVEN in self.also and not self.obstacle(EVEN, model)):
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


def replayed_modes(folder: Path) -> tuple[str, ...]:
    """The modes in which a sequence was replayed, see `in_order`, from their folder."""
    return in_order(path.parent.name for path in folder.glob("*/replay.json"))


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

    ``replays/<sequence>/<mode>`` in the study's folder receives the results. Returned is the number
    of replays that were made.

    Raises
    ------
    AdaptuneError
        If there is no test sequence, the model is of another odometry, other parameters or other
        sub-trajectories, or what the study's own model was fitted to has changed.
    """
    setup = ReplaySetup.of(study)
    model = study.model(model_path)
    setup.check(model, model_path)
    if not study.config.test:
        raise AdaptuneError("test: name at least one sequence to replay")
    obstacles = {name: setup.obstacle(name, model) for name in study.config.online.modes}
    for why in dict.fromkeys(filter(None, obstacles.values())):
        names = " and ".join(name for name, obstacle in obstacles.items() if obstacle == why)
        _log.warning("not replayed: %s, because %s", names, why)
    return replay_modes(study, study.config.test, setup.modes(model), progress, (model, model_path))


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
    fitted: tuple[ErrorModel, Path] | None = None,
) -> int:
    """Replay what was not replayed before; the number of replays that were made.

    Sequences without a reference get an estimated one before, where that is possible. `fitted` is
    the error model and its file. Baseline alone needs none.
    """
    study.open()
    length = study.config.sub_trajectory
    refused = ensure_references(study.sequences, sequences, length, progress, required=False)
    for why in refused.values():
        _log.warning("%s; it is replayed without a reference, and not judged", why)
    setup, made = ReplaySetup.of(study), 0
    in_vain = cache(lambda: _in_vain(study.odometry, study.sequences.open(sequences[0])))
    model, model_path = fitted or (None, None)
    digest = "" if model is None else model.digest
    with pin(os.getpid(), alone=True):  # the estimates had all cores
        for name in sequences:
            folder, shared = study.folder / "replays" / name, study.replay_inputs(name)
            every = [manifest.plain(setup.identity(mode, model, digest) | shared) for mode in modes]
            due = [inputs for inputs in every if _is_due(study, name, inputs)]
            live = [i["mode"] for i in due if setup.mode(i["mode"], model).live]
            if live and (why := in_vain()):
                _log.warning("%s is not replayed on %s: %s", " and ".join(live), name, why)
                due = [inputs for inputs in due if inputs["mode"] not in live]
            if not due and is_reference_of(folder, study.sequences.reference(name)):
                continue
            recording = study.sequences.open(name)
            if due and study.odometry.description.whole:
                study.sequences.program_input(name)  # may be written, which costs no mode
            for i, inputs in enumerate(due):
                mode = setup.mode(inputs["mode"], model)
                release_memory()
                try:
                    instance, what = partial(setup.instance, mode, name), f"{name}, {mode.name}"
                    record = _replayed(study, recording, instance, mode, what, progress)
                except DescriptorError as error:
                    raise AdaptuneError(f"sequences.{name}: {error}") from error
                if i == 0:
                    _judge(study, name, recording, record.trajectory)
                write_replay(folder / mode.name, record, inputs, model_path)
            if not due:
                _judge(study, name, recording, StoredReplay.read(folder / modes[0]).trajectory)
                _log.info("%s: the reference has changed; no replay depends on it", name)
            made += len(due)
    return made


def _in_vain(odometry: Factory, recording: Recording) -> str:
    """Why a ROS system cannot adapt live: it accepts parameters, and does not read them again."""
    if not isinstance(odometry, OdometryFactory) or odometry.name not in ROS_SYSTEMS:
        return ""
    from adaptune.odometry.docker.probe import check_live  # little else needs it

    try:
        check_live(odometry, recording)
    except OdometryError as error:
        return str(error)
    return ""


def _judge(study: Study, name: str, recording: Recording, replayed: Trajectory) -> None:
    """Write the reference of a sequence, and what scans say where a replay disagrees with it."""
    reference, wrong, sequences = recording.reference(), list[Finding](), study.sequences
    if reference is not None:
        T_ref_sensor, T_odom_sensor = reference.at(replayed.stamps), replayed.T_world_sensor
        error = mean_difference(T_ref_sensor, T_odom_sensor, study.config.sub_trajectory)
        seen = set(replayed.stamps.tolist())
        wrong = contradictions_of(sequences, name, T_odom_sensor, error, seen, T_ref_sensor)
        reference = without(reference, wrong, begin_of(recording, replayed.stamps))
    for what in wrong:
        _log.warning("sequences.%s: %s", name, what)
    folder = study.folder / "replays" / name
    write_reference(folder, reference, replayed, sequences.reference(name), wrong)


def _is_due(study: Study, name: str, inputs: manifest.Inputs) -> bool:
    """Whether a replay is to be made; one of other inputs is set aside, an earlier one kept."""
    mode = inputs["mode"]
    folder = study.folder / "replays" / name / mode
    changes = replay_changes(folder, inputs, study.sequences.sources(name))
    if changes:
        _log.info("%s, %s: replayed again: %s", name, mode, "; ".join(changes))
        before = manifest.recorded(folder / manifest.FILE)
        manifest.set_aside(study.folder, folder, before, list(folder.iterdir()))
    if changes != [] and manifest.bring_back(study.folder, folder, inputs):
        _log.info("%s, %s: the earlier replay of these inputs counts again", name, mode)
        changes = replay_changes(folder, inputs)
    return changes != []


def _replayed(
    study: Study,
    recording: Recording,
    instance: Callable[[], OdometryInstance],
    mode: Mode,
    what: str,
    progress: Progress,
    again: bool = False,
) -> ReplayRecord:
    """Replay; the baseline, with which all is compared, once more `again` where it had a fault."""
    online, make, n = study.config.online, mode.selector, recording.n_messages

    def watch(record: ReplayRecord) -> None:
        progress(what, record.done, n)

    with ExitStack() as stack:
        odometry = stack.enter_context(closing(instance()))
        given = recording, odometry, study.config.health
        if online.real_time is None:
            selector = make and make()
            fixed = None if selector is None else selector.fall_back()
            record = replay(*given, selector, online.period, watch, what, fixed)
        else:
            process = make and stack.enter_context(closing(SelectorProcess(make, online.period)))
            record = replay_in_real_time(*given, online.real_time, process, watch, what)
    progress(what, n, n)
    if mode.name != BASELINE or not record.faults:
        return record
    wrong = f"{what}: a fault with the odometry's own parameters: {record.faults[-1]}"
    if again:
        raise AdaptuneError(f"{wrong}; mend the odometry, or leave the sequence out of the test")
    _log.warning("%s; so once more", wrong)
    return _replayed(study, recording, instance, mode, what, progress, again=True)
