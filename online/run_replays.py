"""The online stage: replay the test sequences in every mode."""

import itertools
import logging
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from adaptune.descriptor.base import DescriptorError
from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from adaptune.selection import Selection
from adaptune.sequence.sequence import Sequence
from adaptune.study.config import StudyConfig
from adaptune.study.driven import bank_members
from adaptune.study.study import Study
from adaptune.trajectory import Trajectory, write_tum
from online.modes import Mode, ReplaySetup
from online.replay import Replay, replay
from online.stored_replays import ReplayIdentity, is_current, write_replay

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

SCANT = 1.5
"""Training sequences below which a selection rests on hardly more than one."""

_log = logging.getLogger(__name__)


class ReplayError(AdaptuneError):
    """A study that cannot be replayed."""


def run_replays(
    study: Study, model_path: Path, again: bool = False, progress: Progress = lambda *_: None
) -> int:
    """Replay every test sequence in every mode, unless that was done before.

    Parameters
    ----------
    study
        The study; ``replays/<sequence>/<mode>`` in its folder receives the results.
    model_path
        The error model.
    again
        Replay even what was done before.
    progress
        Called about every scan.

    Returns
    -------
    int
        Number of replays that were made.

    Raises
    ------
    AdaptuneError
        If there is no test sequence, or the model is of another odometry or other parameters.
    """
    model = ErrorModel.load(model_path)
    model.check_study(study.odometry.identity, study.odometry.space, model_path)
    setup = ReplaySetup.of(study)
    if setup.mechanism == "bank":
        bank_members(setup.switching, model)  # refuses another bank before anything runs
    if not study.config.test:
        raise ReplayError("test: name at least one sequence to replay")
    study.open()
    digest = model.digest
    made = 0
    for name in study.config.test:
        folder = study.folder / "replays" / name
        shared = shared_identity(study, name)
        about = {
            mode: ReplayIdentity(**setup.identity(mode, model, digest), **shared)
            for mode in setup.modes
        }
        due = [mode for mode in setup.modes if again or not is_current(folder / mode, about[mode])]
        if not due:
            continue
        sequence = study.sequences.open(name)
        for mode in due:
            started = setup.start(mode, model, name)
            result = _replay(
                study.config, sequence, name, started, partial(progress, f"{name}, {mode}")
            )
            if mode == due[0]:
                _write_reference(folder, sequence.reference(), result.trajectory)
            write_replay(folder / mode, result, about[mode])
            if started.selector is not None:
                selections = [choice.selection for choice in result.choices]
                warn_of_scant_evidence(f"{name}, {mode}", selections, started.selector.fixed)
        made += len(due)
    return made


def _replay(
    config: StudyConfig,
    sequence: Sequence,
    name: str,
    mode: Mode,
    progress: Callable[[int, int], None],
) -> Replay:
    done, n = itertools.count(1), sequence.n_messages
    try:
        result = replay(
            sequence,
            mode.odometry,
            config.health,
            mode.selector,
            config.online.period,
            lambda: progress(next(done), n),
        )
    except DescriptorError as error:
        raise ReplayError(f"sequences.{name}: {error}") from error
    finally:
        mode.odometry.close()
    progress(n, n)
    return result


def warn_of_scant_evidence(what: str, selections: Iterable[Selection], fixed: int) -> None:
    """Warn of selections that rest on hardly more than one training sequence."""
    left = [s for s in selections if s.trial != fixed]
    few = sum(s.n_sequences < SCANT for s in left)
    if few:
        _log.warning(
            "%s: %d of %d selections of another set than the fixed one rest on hardly more than "
            "one training sequence (see selections.csv); more sequences would show whether they "
            "hold",
            what,
            few,
            len(left),
        )


def shared_identity(study: Study, name: str) -> dict[str, Any]:
    """What the replays of a sequence depend on in all modes."""
    return {
        "period": study.config.online.period,
        "odometry": study.config.odometry.model_dump(mode="json"),
        "health": study.config.health.model_dump(mode="json"),
    } | study.sequences.identity(name)


def _write_reference(folder: Path, reference: Trajectory | None, odometry: Trajectory) -> None:
    """Write ``reference.tum``, at the scans' stamps; remove it if there is none."""
    path = folder / "reference.tum"
    if reference is None:
        path.unlink(missing_ok=True)
        return
    T = reference.at(odometry.stamps)
    known = ~np.isnan(T[:, 0, 0])
    if not known.any():
        raise ReplayError(
            f"{folder.name}: the reference does not overlap the scans in time; check that both are "
            f"of the same recording and clock"
        )
    write_tum(path, Trajectory(odometry.stamps[known], T[known]))
