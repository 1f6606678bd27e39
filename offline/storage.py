"""A study's trials in a journal of Optuna's, for its own tools.

The journal is a mirror: the archive is the truth, and nothing is read back.
"""

import logging
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from adaptune.files import needing_room
from adaptune.space import Categorical, Float, Integer, ParameterSet, ParameterSpace

if TYPE_CHECKING:
    import optuna

# Optuna takes a second to import, which a campaign with nothing to do does not need.

JOURNAL = "optuna.log"
"""The journal, in the study's folder."""

_NUMBER = "adaptune trial"
# The line of a trial in the journal.
_LINE = re.compile(rb'"adaptune trial":(\d+)[^\n]*\n')

_log = logging.getLogger(__name__)


class MirrorRow(NamedTuple):
    """A trial as the mirror receives it."""

    parameters: ParameterSet
    values: tuple[float, ...]  # the value of each objective
    attributes: Mapping[str, Any] = {}  # further figures, as plain data
    constraints: Mapping[str, float] = {}  # excess over every limit; negative if the limit is kept


class Mirror:
    """An Optuna study in a study's folder, with its name, that receives every trial once.

    No other process may work in the folder. A damaged journal is written again.
    """

    def __init__(self, folder: Path, n_objectives: int, space: ParameterSpace):
        self._path, self._n_objectives, self._space = folder / JOURNAL, n_objectives, space
        self._study: optuna.Study | None = None
        # A killed driver may have left its lock.
        self._path.with_name(JOURNAL + ".lock").unlink(missing_ok=True)

    def report(self, numbers: Collection[int], row: Callable[[int], MirrorRow]) -> None:
        """Report trials in this order; `row` is called for those that the mirror lacks."""
        # Opening the journal takes long: Optuna reads all of it.
        if self._study is None and _reported(self._path).issuperset(numbers):
            return
        with needing_room(self._path):
            try:
                self._study = self._study or self._opened()
            except (ValueError, KeyError, TypeError, AssertionError) as error:
                _log.warning("%s: is damaged; it is written again (%s)", self._path, error)
                self._path.unlink(missing_ok=True)
                self._study = self._opened()
            self._add(self._study, numbers, row)

    def _opened(self) -> "optuna.Study":
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        if self._path.exists() and not self._path.read_bytes().endswith(b"\n"):
            self._path.unlink()
        return optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(self._path))),
            study_name=self._path.parent.name,
            load_if_exists=True,
            directions=["minimize"] * self._n_objectives,
        )

    def _add(
        self, study: "optuna.Study", numbers: Collection[int], row: Callable[[int], MirrorRow]
    ) -> None:
        from optuna.trial import TrialState, create_trial

        every = {n: distribution(p) for n, p in self._space.parameters.items()}
        trials = study.get_trials(deepcopy=False)
        reported = {trial.user_attrs.get(_NUMBER, trial.number) for trial in trials}
        for number in numbers:
            if number in reported:
                continue
            trial = row(number)
            finite = np.isfinite(trial.values).all()
            parameters = self._space.flat(trial.parameters)
            study.add_trial(
                create_trial(
                    state=TrialState.COMPLETE if finite else TrialState.FAIL,
                    params=parameters,
                    distributions={name: every[name] for name in parameters},
                    values=trial.values if finite else None,
                    user_attrs={_NUMBER: number} | dict(trial.attributes),
                    constraints=dict(trial.constraints),
                )
            )


def _reported(path: Path) -> set[int]:
    """Trial numbers in a journal."""
    try:
        return {int(number) for number in _LINE.findall(path.read_bytes())}
    except FileNotFoundError:
        return set()


def distribution(parameter: Float | Integer | Categorical) -> Any:
    """A parameter as Optuna describes it."""
    from optuna.distributions import (
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

    if isinstance(parameter, Categorical):
        return CategoricalDistribution(parameter.choices)
    if isinstance(parameter, Integer):
        return IntDistribution(parameter.low, parameter.high, log=parameter.log)
    return FloatDistribution(parameter.low, parameter.high, log=parameter.log)
