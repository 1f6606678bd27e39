"""A study's trials in an Optuna storage, for Optuna's own tools.

The storage is a mirror: the archive is the truth. Only the numbers and parameters of mirrored
trials are ever read back.
"""

import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from adaptune.errors import AdaptuneError
from adaptune.files import needing_room
from adaptune.space import Categorical, Float, Integer, ParameterSet, ParameterSpace
from offline.config import OfflineConfig

if TYPE_CHECKING:
    import optuna

# Optuna takes a second to import, which a campaign with nothing to do does not need.

JOURNAL = "optuna.log"
"""The default storage, in the study's folder."""

_NUMBER = "adaptune trial"
# The line of a trial in the journal.
_LINE = re.compile(rb'"adaptune trial":(\d+)[^\n]*\n')
_LOGIN = re.compile(r"://(.*@)")

_log = logging.getLogger(__name__)


class StorageError(AdaptuneError):
    """A storage that cannot be used."""


class MirrorRow(NamedTuple):
    """A trial as the mirror receives it."""

    parameters: ParameterSet
    values: tuple[float, ...]  # the value of each objective
    attributes: Mapping[str, Any] = {}  # further figures, as plain data
    constraints: Mapping[str, float] = {}  # excess over every limit; negative if the limit is kept


def open_mirror(
    folder: Path,
    config: OfflineConfig,
    space: ParameterSpace,
    finished: Mapping[int, ParameterSet],
) -> "Mirror":
    """Open the storage that a study names, by default a journal in its folder.

    The folder's name is the name of the study; no other process may work in it.

    Raises
    ------
    StorageError
        If a database cannot be reached, or holds another study of this name.
    """
    n_objectives = len(config.objective)
    if config.storage is None:
        return JournalMirror(folder / JOURNAL, n_objectives, space)
    return DatabaseMirror(config.storage, folder.name, n_objectives, space, finished)


class Mirror(ABC):
    """An Optuna study that receives every trial once."""

    def __init__(self, name: str, n_objectives: int, space: ParameterSpace):
        self._name = name
        self._n_objectives, self._space = n_objectives, space

    @abstractmethod
    def report(self, numbers: Collection[int], row: Callable[[int], MirrorRow]) -> None:
        """Report trials in this order; `row` is called for those that the mirror lacks."""

    def _create(self, storage: Any) -> "optuna.Study":
        import optuna

        return optuna.create_study(
            storage=storage,
            study_name=self._name,
            load_if_exists=True,
            directions=["minimize"] * self._n_objectives,
        )

    @staticmethod
    def _known(mirror: "optuna.Study") -> dict[int, ParameterSet]:
        trials = mirror.get_trials(deepcopy=False)
        return {trial.user_attrs.get(_NUMBER, trial.number): trial.params for trial in trials}

    def _add(
        self, mirror: "optuna.Study", numbers: Collection[int], row: Callable[[int], MirrorRow]
    ) -> None:
        from optuna.trial import TrialState, create_trial

        every = {n: distribution(p) for n, p in self._space.parameters.items()}
        known = self._known(mirror)
        for number in numbers:
            if number in known:
                continue
            trial = row(number)
            finite = np.isfinite(trial.values).all()
            parameters = self._space.flat(trial.parameters)
            mirror.add_trial(
                create_trial(
                    state=TrialState.COMPLETE if finite else TrialState.FAIL,
                    params=parameters,
                    distributions={name: every[name] for name in parameters},
                    values=trial.values if finite else None,
                    user_attrs={_NUMBER: number} | dict(trial.attributes),
                    constraints=dict(trial.constraints),
                )
            )


class JournalMirror(Mirror):
    """A journal file in the study's folder; a damaged one is written again."""

    def __init__(self, path: Path, n_objectives: int, space: ParameterSpace):
        super().__init__(path.parent.name, n_objectives, space)
        self._path = path
        self._mirror: optuna.Study | None = None
        # A killed driver may have left its lock.
        self._path.with_name(JOURNAL + ".lock").unlink(missing_ok=True)

    def report(self, numbers: Collection[int], row: Callable[[int], MirrorRow]) -> None:
        """See `Mirror`."""
        if self._mirror is None:
            # Opening the journal takes long: Optuna reads all of it.
            if _reported(self._path).issuperset(numbers):
                return
            with needing_room(self._path):
                self._mirror = self._open()
        with needing_room(self._path):
            self._add(self._mirror, numbers, row)

    def _open(self) -> "optuna.Study":
        if self._path.exists() and not self._path.read_bytes().endswith(b"\n"):
            self._path.unlink()
        try:
            return self._create(_journal(self._path))
        except (ValueError, KeyError, TypeError, AssertionError) as error:
            _log.warning("%s: is damaged; it is written again (%s)", self._path, error)
            self._path.unlink(missing_ok=True)
            return self._create(_journal(self._path))


def _journal(path: Path) -> "optuna.storages.JournalStorage":
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    return JournalStorage(JournalFileBackend(str(path)))


def _reported(path: Path) -> set[int]:
    """Trial numbers in a journal."""
    try:
        return {int(number) for number in _LINE.findall(path.read_bytes())}
    except FileNotFoundError:
        return set()


class DatabaseMirror(Mirror):
    """A database that SQLAlchemy and Optuna support, such as PostgreSQL."""

    def __init__(
        self,
        url: str,
        name: str,
        n_objectives: int,
        space: ParameterSpace,
        finished: Mapping[int, ParameterSet],
    ):
        import sqlalchemy.exc

        super().__init__(name, n_objectives, space)
        if url.startswith("postgresql://"):
            url = url.replace("://", "+pg8000://", 1)
        # Messages must not show the password.
        self._where = f"offline.storage: {_LOGIN.sub('://', url)}"
        self._complained = False
        try:
            self._mirror = self._create(url)
        except ImportError as error:
            raise StorageError(
                f"{self._where}: its driver is not installed; for PostgreSQL, "
                f"pip install 'adaptune[postgres]'"
            ) from error
        except sqlalchemy.exc.ArgumentError as error:
            raise StorageError(
                f"{self._where}: is not the URL of a database, such as "
                f"postgresql://user@host/database"
            ) from error
        except sqlalchemy.exc.SQLAlchemyError as error:
            raise StorageError(
                f"{self._where}: cannot be reached ({_first_line(error)}); start it, or leave the "
                f"key out: a file in the study's folder does without a server"
            ) from error
        self._check(finished)

    def _check(self, finished: Mapping[int, ParameterSet]) -> None:
        """Refuse a database that holds another study of this name."""
        known = self._known(self._mirror)
        common = known.keys() & finished.keys()
        if known and (not common or any(known[n] != self._space.flat(finished[n]) for n in common)):
            raise StorageError(
                f"{self._where}: holds {len(known)} trials of another study named {self._name}; "
                f"give this study a folder of another name (--folder), or remove that one with "
                f"`optuna delete-study`"
            )

    def report(self, numbers: Collection[int], row: Callable[[int], MirrorRow]) -> None:
        """See `Mirror`; a database that is away receives the trials when it returns."""
        from optuna.exceptions import StorageInternalError
        from sqlalchemy.exc import SQLAlchemyError

        try:
            self._add(self._mirror, numbers, row)
        except (SQLAlchemyError, StorageInternalError) as error:
            if not self._complained:
                _log.warning(
                    "%s: does not receive trials now, the archive keeps them (%s)",
                    self._where,
                    _first_line(error),
                )
            self._complained = True
        else:
            self._complained = False


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


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]
