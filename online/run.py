"""The online stage: replay the test sequences in every mode."""

import logging
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.model.descriptor import DescriptorError
from adaptune.processes import release_memory
from adaptune.progress import Progress, unseen
from adaptune.recording.scan import Recording
from adaptune.selection import Selection
from adaptune.study.config import StudyConfig
from adaptune.study.references import ensure_references
from adaptune.study.study import Study
from online.modes import UNTRAINED, WITHOUT_MODEL, ReplaySetup, sequences_without_model
from online.real_time import SelectorProcess, replay_in_real_time
from online.record import (
    StoredReplay,
    is_reference_of,
    repeat_folder,
    replay_changes,
    write_reference,
    write_replay,
)
from online.replay import Look, ReplayRecord, Watch, replay

MIN_SEQUENCES = 1.5
"""Effective training stretches below which a selection rests on hardly more than one."""

_log = logging.getLogger(__name__)


class ReplayError(AdaptuneError):
    """A study that cannot be replayed."""


def run_replays(
    study: Study,
    model_path: Path,
    progress: Progress = unseen,
    look: Look = lambda *_: None,
) -> int:
    """Replay every test sequence in every mode, as often as asked, unless that was done before.

    Parameters
    ----------
    study
        The study; ``replays/<sequence>/<mode>`` in its folder receives the results, and
        ``repeat_2`` in it, and so on, those of repeats.
    model_path
        The error model.
    progress
        Called about every scan.
    look
        Sees every scan, see `online.dashboard.Dashboard.look`.

    Returns
    -------
    int
        Number of replays that were made.

    Raises
    ------
    AdaptuneError
        If there is no test sequence, the model is of another odometry, other parameters or other
        sub-trajectories, or what the study's own model was fitted to has changed.
    """
    setup = ReplaySetup.of(study)
    model = setup.model(study, model_path)
    if not study.config.test:
        raise ReplayError("test: name at least one sequence to replay")
    asked = (*study.config.online.rules, *setup.also)
    obstacles = {name: setup.obstacle(name, model) for name in asked}
    for why in dict.fromkeys(filter(None, obstacles.values())):
        names = " and ".join(name for name in asked if obstacles[name] == why)
        _log.warning("not replayed: %s, because %s", names, why)
    modes = _Modes(setup, setup.modes(model), progress, look, model, model_path)
    return _replay_all(study, study.config.test, modes)


def run_untrained(
    study: Study,
    progress: Progress = unseen,
    look: Look = lambda *_: None,
) -> int:
    """Replay sequences with the baseline, and with a bank that needs no model.

    Neither trials nor references are needed. The sequences are those of
    `online.modes.sequences_without_model`; for the rest see `run_replays`.

    Raises
    ------
    AdaptuneError
        If a bank of the odometry is not possible.
    """
    setup = ReplaySetup.of(study)
    setup.mode(UNTRAINED)  # or an error
    modes = _Modes(setup, WITHOUT_MODEL, progress, look)
    return _replay_all(study, sequences_without_model(study.config), modes)


class _Run(NamedTuple):
    """A replay to make."""

    sequence: str
    mode: str
    repeat: int = 1

    def __str__(self) -> str:
        again = "" if self.repeat == 1 else f", repeat {self.repeat}"
        return f"{self.sequence}, {self.mode}{again}"


class _Modes(NamedTuple):
    """The modes to replay, who looks on, and the model of those that need one."""

    setup: ReplaySetup
    names: tuple[str, ...]
    progress: Progress
    look: Look
    model: ErrorModel | None = None
    model_path: Path | None = None


def _replay_all(study: Study, sequences: Sequence[str], modes: _Modes) -> int:
    """Replay what was not replayed before; the number of replays that were made.

    Sequences without a reference get an estimated one before, where that is possible.
    """
    study.open()
    refused = ensure_references(study, sequences, modes.progress, required=False)
    for why in refused.values():
        _log.warning("%s; it is replayed without a reference, and not judged", why)
    made = 0
    for name in sequences:
        folder, every = study.folder / "replays" / name, _inputs(study, name, modes)
        due = {run: inputs for run, inputs in every.items() if _is_due(study, run, inputs)}
        poses = study.sequences.reference(name)
        if not due and is_reference_of(folder, poses):
            continue
        recording = study.sequences.open(name)
        for i, (run, inputs) in enumerate(due.items()):
            record = _replayed(study.config, recording, run, modes)
            if i == 0:
                write_reference(folder, recording.reference(), record.trajectory, poses)
            of_run = repeat_folder(folder / run.mode, run.repeat)
            write_replay(of_run, record, inputs, modes.model_path)
        if not due:
            trajectory = StoredReplay.read(folder / modes.names[0]).trajectory
            write_reference(folder, recording.reference(), trajectory, poses)
            _log.info("%s: the reference has changed; no replay depends on it", name)
        made += len(due)
    return made


def _is_due(study: Study, run: _Run, inputs: manifest.Inputs) -> bool:
    """Whether a replay is to be made; one of other inputs is set aside, an earlier one kept."""
    folder = repeat_folder(study.folder / "replays" / run.sequence / run.mode, run.repeat)
    files_of = study.sequences.sources(run.sequence)
    changes = replay_changes(folder, inputs, files_of)
    if changes:
        _log.info("%s: replayed again: %s", run, "; ".join(changes))
        before, files = manifest.recorded(folder / manifest.FILE), folder.iterdir()
        manifest.set_aside(study.folder, folder, before, [file for file in files if file.is_file()])
    if changes != [] and manifest.bring_back(study.folder, folder, inputs):
        _log.info("%s: the earlier replay of these inputs counts again", run)
        changes = replay_changes(folder, inputs)
    return changes != []


def _inputs(study: Study, name: str, modes: _Modes) -> dict[_Run, dict[str, Any]]:
    """What all replays of a sequence are made from; each mode has its first before any second."""
    shared = shared_identity(study, name)
    digest = "" if modes.model is None else modes.model.digest
    about = {mode: modes.setup.identity(mode, modes.model, digest) | shared for mode in modes.names}
    return {
        _Run(name, mode, repeat): manifest.plain(of | {"repeat": repeat})
        for repeat in range(1, study.config.online.repeats + 1)
        for mode, of in about.items()
    }


def _replayed(config: StudyConfig, recording: Recording, run: _Run, modes: _Modes) -> ReplayRecord:
    """Make a replay."""
    what, n = str(run), recording.n_messages
    release_memory()

    def watch(record: ReplayRecord) -> None:
        modes.progress(what, record.done, n)
        modes.look(what, n, record)

    try:
        drive = _in_lockstep if config.online.real_time is None else _in_real_time
        record = drive(config, recording, run, modes, watch)
    except DescriptorError as error:
        raise ReplayError(f"sequences.{run.sequence}: {error}") from error
    modes.progress(what, n, n)
    if modes.model is not None and record.choices:
        selections = [choice.selection for choice in record.choices]
        fixed = modes.setup.mode(run.mode, modes.model).fixed
        warn_of_scant_evidence(what, selections, fixed)
    return record


def _in_lockstep(
    config: StudyConfig, recording: Recording, run: _Run, modes: _Modes, watch: Watch
) -> ReplayRecord:
    odometry, selector = modes.setup.start(run.mode, modes.model, run.sequence)
    with closing(odometry):
        return replay(
            recording,
            odometry,
            config.health,
            selector,
            config.online.period,
            watch,
            str(run),
            None if selector is None else selector.fall_back(),
        )


def _in_real_time(
    config: StudyConfig, recording: Recording, run: _Run, modes: _Modes, watch: Watch
) -> ReplayRecord:
    assert config.online.real_time is not None
    mode = modes.setup.mode(run.mode, modes.model)
    odometry = modes.setup.instance(mode, run.sequence)
    selector = None
    with closing(odometry), ExitStack() as stack:
        if mode.selector is not None:
            selector = SelectorProcess(mode.selector, config.online.period)
            stack.enter_context(closing(selector))
        return replay_in_real_time(
            recording,
            odometry,
            config.health,
            config.online.real_time,
            selector,
            watch,
            str(run),
        )


def warn_of_scant_evidence(what: str, selections: Iterable[Selection], fixed: int) -> None:
    """Warn of selections that rest on hardly more than one training stretch."""
    others = [s for s in selections if s.trial != fixed]
    scant = sum(s.n_sequences < MIN_SEQUENCES for s in others)
    if scant:
        _log.warning(
            "%s: %d of %d selections of another set than the fixed one rest on hardly more than "
            "one stretch of the training (see selections.csv); more recordings would show whether "
            "they hold",
            what,
            scant,
            len(others),
        )


def shared_identity(study: Study, name: str) -> dict[str, Any]:
    """What the replays of a sequence depend on in all modes."""
    in_real_time = study.config.online.real_time
    return {
        "period": study.config.online.period,
        "real_time": in_real_time and in_real_time.model_dump(mode="json"),
        "health": study.config.health.model_dump(mode="json"),
        **study.odometry_inputs,
        **study.sequences.identity(name),
    }
