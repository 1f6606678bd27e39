"""What a study knows as a table, in the form of algorithm-selection benchmarks (ASlib).

Instances are frames, algorithms are parameter sets. So selection rules compare without an odometry.
"""

import csv
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import Archive
from adaptune.errors import AdaptuneError
from adaptune.files import replacing, write_text
from adaptune.report.tables import csv_text
from adaptune.space import ParameterSets
from adaptune.study.driven import MIN_RECORDINGS
from offline.config import OfflineStudy
from offline.labelled import labelled_data


class Scenario(NamedTuple):
    """Frames that have a sub-trajectory, and what every set does there."""

    sequence: NDArray[np.str_]  # (n,)
    frame: NDArray[np.intp]  # (n,): number in the sequence
    fold: NDArray[np.intp]  # (n,): of a recording or, with few of them, of a stretch
    features: NDArray[np.float32]  # (n, n_features): averaged descriptors
    # (n, n_sets): RTE in percent, infinite where the track was lost
    performances: NDArray[np.float32]
    trial: NDArray[np.intp]  # (n_sets,): number of each set
    cost: NDArray[np.float64]  # (n_sets,): milliseconds of CPU time a scan

    def columns(self) -> dict[str, NDArray[Any]]:
        """All but the costs, as columns of equal length."""
        features = {f"feature_{i}": of for i, of in enumerate(self.features.T)}
        errors = {f"rte_{n}": of for n, of in zip(self.trial, self.performances.T, strict=True)}
        return {name: getattr(self, name) for name in self._fields[:3]} | features | errors


def scenario(study: OfflineStudy) -> Scenario:
    """The errors of all sets that are finished on all training sequences of a study.

    Raises
    ------
    AdaptuneError
        If there is none.
    """
    archive, names = Archive(study.folder / "trials"), study.training
    numbers = sorted(set.intersection(*(set(archive.finished(name)) for name in names)))
    if not numbers:
        raise AdaptuneError(f"{archive.folder}: no trial is finished yet; run `adaptune offline`")
    tried = tuple(archive.finished(names[0])[n].parameters for n in numbers)
    sets = ParameterSets(study.odometry.space, tuple(numbers), tried)
    about = (study.config, study.window, study.sequences.recorded_in, study.odometry)
    data = labelled_data(archive, names, sets, *about)
    recordings = np.concatenate([np.full(len(s.known), s.recording) for s in data.sequences])
    several = len(data.recordings) >= MIN_RECORDINGS
    fold = np.unique(recordings, return_inverse=True)[1] if several else data.stretches()
    return Scenario(
        np.concatenate([np.full(len(s.known), s.name) for s in data.sequences]),
        np.concatenate([s.known for s in data.sequences]),
        fold,
        np.concatenate([s.descriptors for s in data.sequences]),
        np.concatenate([s.errors for s in data.sequences]),
        np.array(numbers),
        np.array([data.costs.alone(n) for n in numbers]),
    )


def write_scenario(path: Path | str, found: Scenario) -> Path:
    """Write the table as CSV or Parquet, and beside it the costs, to the file that is returned."""
    path = Path(path)
    columns, costs = found.columns(), path.with_name(f"{path.stem}_costs.csv")
    if path.suffix == ".parquet":
        with replacing(path) as temporary:
            _pandas(path).DataFrame(columns).to_parquet(temporary)
    else:
        write_text(path, _csv(columns))
    write_text(costs, _csv({"trial": found.trial, "cost": found.cost}))
    return costs


def read_scenario(path: Path | str) -> Scenario:
    """Read what `write_scenario` wrote; an AdaptuneError says that it is no such table."""
    path = Path(path)
    try:
        columns = _columns(path)
        costs = _columns(path.with_name(f"{path.stem}_costs.csv"))
        features, errors = (
            np.stack([of for name, of in columns.items() if name.startswith(kind)], axis=1)
            for kind in ("feature_", "rte_")
        )
        return Scenario(
            columns["sequence"].astype(str),
            columns["frame"].astype(np.intp),
            columns["fold"].astype(np.intp),
            features.astype(np.float32),
            errors.astype(np.float32),
            costs["trial"].astype(np.intp),
            costs["cost"].astype(float),
        )
    except (OSError, ValueError, KeyError) as error:
        raise AdaptuneError(f"{path}: is no table of errors: {error}") from error


def _csv(columns: dict[str, NDArray[Any]]) -> str:
    rows = zip(*columns.values(), strict=True)
    return csv_text([dict(zip(columns, row, strict=True)) for row in rows])


def _columns(path: Path) -> dict[str, NDArray[Any]]:
    if path.suffix == ".parquet":
        return {name: of.to_numpy() for name, of in _pandas(path).read_parquet(path).items()}
    with path.open(encoding="utf-8", newline="") as file:
        names, *rows = csv.reader(file)
    return dict(zip(names, np.array(rows).T, strict=True))


def _pandas(path: Path) -> Any:
    try:
        import pandas as pd
        import pyarrow  # noqa: F401
    except ImportError as error:
        what = "Parquet needs pandas and pyarrow; install them, or name a .csv"
        raise AdaptuneError(f"{path}: {what}") from error
    return pd
