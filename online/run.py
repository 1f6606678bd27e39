"""The online stage: replay the test sequences in every mode."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from adaptune import manifest
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.model.descriptor import DescriptorError
from adaptune.processes import release_memory
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

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

SCANT = 1.5
"""Training sequences below which a selection rests on hardly more than one."""

_log = logging.getLogger(__name__)


class ReplayError(AdaptuneError):
    """A study that cannot be replayed."""


def run_replays(
    study: Study,
    model_path: Path,
    progress: Progress = lambda *_: None,
    look: Look | None = None,
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
    modes = _Modes(setup, setup.modes(model), look, model, model_path)
    return _replay_all(study, study.config.test, modes, progress)


def run_untrained(
    study: Study,
    progress: Progress = lambda *_: None,
    look: Look | None = None,
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
    modes = _Modes(setup, WITHOUT_MODEL, look)
    return _replay_all(study, sequences_without_model(study.config), modes, progress)


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
    look: Look | None = None
    model: ErrorModel | None = None
    model_path: Path | None = None


def _replay_all(study: Study, sequences: Sequence[str], modes: _Modes, progress: Progress) -> int:
    """Replay what was not replayed before; the number of replays that were made.

    Sequences without a reference get an estimated one before, where that is possible.
    """
    study.open()
    refused = ensure_references(study, sequences, progress, required=False)
    for said in refused.values():
        _log.warning("%s; it is replayed without a reference, and not judged", said)
    made = 0
    for name in sequences:
        folder, due = study.folder / "replays" / name, dict[_Run, dict[str, Any]]()
        for run, inputs in _inputs(study, name, modes).items():
            if _is_due(study, run, inputs):
                due[run] = inputs
        if due:
            _replay_due(study, name, due, modes, progress)
        else:
            _renew_reference(study, name, folder / modes.names[0])
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


def _replay_due(
    study: Study,
    name: str,
    due: Mapping[_Run, dict[str, Any]],
    modes: _Modes,
    progress: Progress,
) -> None:
    """Make some replays of a sequence."""
    folder = study.folder / "replays" / name
    poses, sequence = study.sequences.reference(name), study.sequences.open(name)
    for i, (run, about) in enumerate(due.items()):
        what = str(run)
        release_memory()
        drive = _in_lockstep if study.config.online.real_time is None else _in_real_time
        try:
            watch = partial(_watch, progress, modes.look, what, sequence.n_messages)
            result = drive(study.config, sequence, run, modes, watch)
        except DescriptorError as error:
            raise ReplayError(f"sequences.{name}: {error}") from error
        progress(what, sequence.n_messages, sequence.n_messages)
        if i == 0:
            write_reference(folder, sequence.reference(), result.trajectory, poses)
        write_replay(repeat_folder(folder / run.mode, run.repeat), result, about, modes.model_path)
        if modes.model is not None and result.choices:
            selections = [choice.selection for choice in result.choices]
            fixed = modes.setup.mode(run.mode, modes.model).fixed
            warn_of_scant_evidence(what, selections, fixed)


def _watch(progress: Progress, look: Look | None, what: str, n: int, record: ReplayRecord) -> None:
    """Pass on how far a replay is."""
    progress(what, record.done, n)
    if look is not None:
        look(what, n, record)


def _renew_reference(study: Study, name: str, replayed: Path) -> None:
    """Write the reference beside the replays again, if it has changed."""
    poses = study.sequences.reference(name)
    if not is_reference_of(replayed.parent, poses):
        trajectory = StoredReplay.read(replayed).trajectory
        reference = study.sequences.open(name).reference()
        write_reference(replayed.parent, reference, trajectory, poses)
        _log.info("%s: the reference has changed; no replay depends on it", name)


def _in_lockstep(
    config: StudyConfig, sequence: Recording, run: _Run, modes: _Modes, watch: Watch
) -> ReplayRecord:
    odometry, selector = modes.setup.start(run.mode, modes.model, run.sequence)
    with closing(odometry):
        return replay(
            sequence,
            odometry,
            config.health,
            selector,
            config.online.period,
            watch,
            str(run),
            None if selector is None else selector.fall_back(),
        )


def _in_real_time(
    config: StudyConfig, sequence: Recording, run: _Run, modes: _Modes, watch: Watch
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
            sequence,
            odometry,
            config.health,
            config.online.real_time,
            selector,
            watch,
            str(run),
        )


def warn_of_scant_evidence(what: str, selections: Iterable[Selection], fixed: int) -> None:
    """Warn of selections that rest on hardly more than one training stretch."""
    left = [s for s in selections if s.trial != fixed]
    few = sum(s.n_sequences < SCANT for s in left)
    if few:
        _log.warning(
            "%s: %d of %d selections of another set than the fixed one rest on hardly more than "
            "one stretch of the training (see selections.csv); more recordings would show whether "
            "they hold",
            what,
            few,
            len(left),
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
