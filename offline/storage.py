"""A study's trials in an Optuna storage, where Optuna's own tools find them.

It is a mirror: the archive is the truth, and nothing is ever read back from it but what it has
been told.
"""

import logging
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import optuna
import sqlalchemy.exc
from optuna.storages.journal import JournalFileBackend

from adaptune.errors import AdaptuneError
from adaptune.files import needing_room
from adaptune.space import Categorical, Float, Integer, ParameterSet
from adaptune.study import Study

JOURNAL = "optuna.log"
"""The default storage, in the study's folder."""

_NUMBER = "adaptune trial"
# Each trial is a line of the journal with this in it.
_LINE = re.compile(rb'"adaptune trial":(\d+)[^\n]*\n')
_LOGIN = re.compile(r"://(.*@)")

_log = logging.getLogger(__name__)


class StorageError(AdaptuneError):
    """A storage that cannot be used."""


class Told(NamedTuple):
    """What the storage is told of a trial.

    Attributes
    ----------
    parameters : dict
    values : tuple of float
        What is minimised, one for each objective.
    attributes : dict
        What else there is to know, as plain data.
    constraints : dict
        For every limit by how much it is exceeded; negative if it is kept.
    """

    parameters: ParameterSet
    values: tuple[float, ...]
    attributes: Mapping[str, Any] = {}
    constraints: Mapping[str, float] = {}


def open_mirror(study: Study, finished: Mapping[int, ParameterSet]) -> "Mirror":
    """Open the storage that the study names; a journal in its folder if it names none.

    Parameters
    ----------
    study
        The study; no other process must be at work in its folder.
    finished
        Parameters of its finished trials, by number.

    Raises
    ------
    StorageError
        If a database cannot be reached, or holds another study of this name.
    """
    url = study.config.offline.storage
    return JournalMirror(study) if url is None else DatabaseMirror(study, url, finished)


class Mirror(ABC):
    """An Optuna study that is told every trial once, in the order of their numbers."""

    def __init__(self, study: Study):
        self._name = study.name
        self._directions = [optuna.study.StudyDirection.MINIMIZE] * len(
            study.config.offline.objective
        )
        self._distributions = {n: distribution(p) for n, p in study.space.parameters.items()}

    @abstractmethod
    def tell(self, numbers: Collection[int], trial: Callable[[int], Told]) -> None:
        """Tell of trials in this order; those that it knows are not asked for again."""

    def _create(self, storage: Any) -> optuna.Study:
        return optuna.create_study(
            storage=storage,
            study_name=self._name,
            load_if_exists=True,
            directions=self._directions,
        )

    @staticmethod
    def _known(mirror: optuna.Study) -> dict[int, ParameterSet]:
        trials = mirror.get_trials(deepcopy=False)
        return {trial.user_attrs.get(_NUMBER, trial.number): trial.params for trial in trials}

    def _add(
        self, mirror: optuna.Study, numbers: Collection[int], trial: Callable[[int], Told]
    ) -> None:
        known = self._known(mirror)
        for number in numbers:
            if number in known:
                continue
            told = trial(number)
            finite = np.isfinite(told.values).all()
            mirror.add_trial(
                optuna.trial.create_trial(
                    state=optuna.trial.TrialState.COMPLETE if finite else _FAIL,
                    params=told.parameters,
                    distributions=self._distributions,
                    values=told.values if finite else None,
                    user_attrs={_NUMBER: number} | dict(told.attributes),
                    constraints=dict(told.constraints),
                )
            )


_FAIL = optuna.trial.TrialState.FAIL


class JournalMirror(Mirror):
    """A journal file in the study's folder, made anew should it be damaged."""

    def __init__(self, study: Study):
        super().__init__(study)
        self._path = study.folder / JOURNAL
        self._mirror: optuna.Study | None = None
        # A driver that was killed may have left its lock behind.
        self._path.with_name(JOURNAL + ".lock").unlink(missing_ok=True)

    def tell(self, numbers: Collection[int], trial: Callable[[int], Told]) -> None:
        """See `Mirror`."""
        if self._mirror is None:
            # Optuna replays a journal when it is opened, which takes its time.
            if _told(self._path).issuperset(numbers):
                return
            with needing_room(self._path):
                self._mirror = self._open()
        with needing_room(self._path):
            self._add(self._mirror, numbers, trial)

    def _open(self) -> optuna.Study:
        if self._path.exists() and not self._path.read_bytes().endswith(b"\n"):
            self._path.unlink()
        try:
            return self._create(_journal(self._path))
        except (ValueError, KeyError, TypeError, AssertionError) as error:
            _log.warning("%s: is damaged and made anew (%s)", self._path, error)
            self._path.unlink(missing_ok=True)
            return self._create(_journal(self._path))


def _journal(path: Path) -> optuna.storages.JournalStorage:
    return optuna.storages.JournalStorage(JournalFileBackend(str(path)))


def _told(path: Path) -> set[int]:
    """Numbers of the trials in a journal."""
    try:
        return {int(number) for number in _LINE.findall(path.read_bytes())}
    except FileNotFoundError:
        return set()


class DatabaseMirror(Mirror):
    """A database that SQLAlchemy and Optuna know, such as PostgreSQL.

    Parameters
    ----------
    study
        The study; its folder's name is the name of the study in the database.
    url
        Of the database.
    finished
        See `open_mirror`.
    """

    def __init__(self, study: Study, url: str, finished: Mapping[int, ParameterSet]):
        super().__init__(study)
        if url.startswith("postgresql://"):
            url = url.replace("://", "+pg8000://", 1)
        # Passwords are not for logs.
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
        told = self._known(self._mirror)
        common = told.keys() & finished.keys()
        if told and (not common or any(told[n] != finished[n] for n in common)):
            raise StorageError(
                f"{self._where}: holds {len(told)} trials of another study named {self._name}; "
                f"give this study a folder of another name (--folder), or remove that one with "
                f"`optuna delete-study`"
            )

    def tell(self, numbers: Collection[int], trial: Callable[[int], Told]) -> None:
        """See `Mirror`; a database that has gone is told with later ones, if it returns."""
        try:
            self._add(self._mirror, numbers, trial)
        except (sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError) as error:
            if not self._complained:
                _log.warning(
                    "%s: is not told of trials now, the archive keeps them (%s)",
                    self._where,
                    _first_line(error),
                )
            self._complained = True
        else:
            self._complained = False


def distribution(parameter: Float | Integer | Categorical) -> Any:
    """What Optuna calls a parameter."""
    if isinstance(parameter, Categorical):
        return optuna.distributions.CategoricalDistribution(parameter.choices)
    if isinstance(parameter, Integer):
        return optuna.distributions.IntDistribution(
            parameter.low, parameter.high, log=parameter.log
        )
    return optuna.distributions.FloatDistribution(parameter.low, parameter.high, log=parameter.log)


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0]
