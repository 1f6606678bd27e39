"""What a study knows as a table, in the form of algorithm-selection benchmarks (ASlib).

Instances are frames, algorithms are parameter sets. So selection rules compare without an odometry.
"""

import csv
import json
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune._system.files import replacing, write_text
from adaptune.errors import AdaptuneError
from adaptune.metrics import cap
from adaptune.model import ErrorModel, Rule, TrainingData
from adaptune.model.registry import call_user_code, selected
from adaptune.model.rules import Costs, FixedSet, SetCost
from adaptune.paired import MIN_BLOCKS, MIN_RECORDINGS, of_segments
from adaptune.report.tables import csv_text
from adaptune.runs.archive import Archive
from adaptune.space import ParameterSets, load_space
from offline.bank_choice import log_ratios
from offline.choice import BlockErrors, choose
from offline.config import OfflineStudy
from offline.labelled import block_means, labelled_data


class Scenario(NamedTuple):
    """Frames that have a sub-trajectory, and what every set does there."""

    sequence: NDArray[np.str_]  # (n,)
    frame: NDArray[np.intp]  # (n,): number in the sequence
    end: NDArray[np.intp]  # (n,): last frame of its sub-trajectory
    segment: NDArray[np.intp]  # (n,): number of its segment
    fold: NDArray[np.intp]  # (n,): of a recording or, with few of them, of a segment
    time: NDArray[np.float64]  # (n,): seconds from the sequence's first scan
    place: NDArray[np.float64]  # (n, 3): metres, by the reference
    features: NDArray[np.float32]  # (n, n_features): averaged descriptors
    # (n, n_sets): RTE in percent, infinite where the track was lost
    performances: NDArray[np.float32]
    blocks: dict[str, int]  # by name, in order, the number of features of each descriptor
    sets: ParameterSets
    cost: NDArray[np.float64]  # (n_sets,): milliseconds of CPU time a scan; NaN if unknown
    # Trials that `online` lets a rule select: a bank's members, or what is within the budget.
    candidates: tuple[int, ...]

    def columns(self) -> dict[str, NDArray[Any]]:
        """What is known of frames, as columns of equal length."""
        features = {f"feature_{i}": values for i, values in enumerate(self.features.T)}
        errors = {
            f"rte_{n}": values for n, values in zip(self.sets, self.performances.T, strict=True)
        }
        where = {"time": self.time} | dict(zip("xyz", self.place.T, strict=True))
        return {name: getattr(self, name) for name in _OF_FRAMES} | where | features | errors

    def fixed(self, frames: NDArray[np.bool_]) -> int:
        """Trial number of the fixed set by some frames, with their segments as blocks."""
        segment = self.segment[frames]
        _, first = np.unique(segment, return_index=True)
        _, sequence = np.unique(self.sequence[frames][first], return_inverse=True)
        errors, restarts = block_means(self.performances[frames], segment), np.zeros(len(self.sets))
        return choose(BlockErrors(self.sets.trials, errors, sequence, self.cost, restarts))

    def score(self, *rules: Rule) -> list[dict[str, Any]]:
        """A row each for rules, and for the fixed set, the best single set and the best of all.

        Columns are the mean error in percent, the ratio to the fixed set's with its 95 % interval,
        and the cost. The last two are known in hindsight only. See `select`.
        """
        clipped, column = cap(self.performances), list(self.sets.trials).index
        some = [column(trial) for trial in self.candidates]
        single = some[int(np.argmin(clipped[:, some].mean(axis=0)))]
        chosen = {type(rule).__name__: self.select(rule) for rule in rules}
        chosen |= {"fixed": self.select(FixedSet())}
        chosen |= {"best single set": np.full(len(clipped), single)}
        chosen["oracle"] = np.array(some)[np.argmin(clipped[:, some], axis=1)]
        frames, rows = np.arange(len(clipped)), []
        of = clipped[frames, chosen["fixed"]]
        _, first = np.unique(self.segment, return_index=True)
        for name, columns in chosen.items():
            errors, cost = clipped[frames, columns], float(self.cost[columns].mean())
            logs = log_ratios(errors, of, self.segment)
            value, ends, _ = of_segments(logs, self.sequence[first].tolist())
            low, high = ends if ends and len(logs) >= MIN_BLOCKS else (None, None)
            row = {"rule": name, "RTE [%]": float(errors.mean()), "vs fixed": value}
            rows.append(row | {"low": low, "high": high, "cost [ms]": cost})
        return rows

    def select(self, rule: Rule) -> NDArray[np.intp]:
        """Columns of the sets that a rule selects among the `candidates`, of shape (n,).

        Each fold is left out in turn, and with it the frames whose sub-trajectories overlap it. The
        rule is fitted to the rest, with the fixed set of the rest.

        Raises
        ------
        AdaptuneError
            If nothing is left without a fold, or if the rule weighs the members of a bank.
        """
        if isinstance(rule, type):
            raise AdaptuneError(f"{rule.__name__}: is a class; give an object, {rule.__name__}()")
        from adaptune.model.knn import ScaledPCA  # takes long to import

        found = np.empty(len(self.frame), np.intp)
        each = {n: SetCost(cost, 0.0, n) for n, cost in zip(self.sets, self.cost, strict=True)}
        for fold in np.unique(self.fold):
            left_out = self.fold == fold
            rest = ~(left_out | self._overlapping(left_out))
            if not rest.any():
                raise AdaptuneError(f"nothing is left to learn from without fold {fold}")
            pca = ScaledPCA(self.blocks.values())
            features = pca.fit(self.features[rest]).transform(self.features)
            of_rest = features[rest], self.segment[rest], self.performances[rest]
            fixed, costs = self.fixed(rest), Costs(each, 0.0)
            some = tuple(dict.fromkeys((fixed, *self.candidates)))
            call_user_code(rule.fit, TrainingData(*of_rest, self.sets, fixed, some, costs=costs))
            for i in np.flatnonzero(left_out):
                selection = selected(rule, self.sets, features[i])
                if selection.weights is not None:
                    why = "its error is not one of the table's; take `adaptune validate`"
                    raise AdaptuneError(f"{type(rule).__name__}: weighs a bank: {why}")
                if selection.trial not in some:
                    raise AdaptuneError(
                        f"{type(rule).__name__}: selects trial {selection.trial}, which is none of "
                        f"data.candidates"
                    )
                found[i] = self.sets.column(selection.trial)
        return found

    def _overlapping(self, left_out: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Frames of the same sequences whose sub-trajectories overlap those of some frames."""
        found = np.zeros(len(left_out), np.bool_)
        for name in np.unique(self.sequence[left_out]):
            these = left_out & (self.sequence == name)
            first, last = self.frame[these].min(), self.end[these].max()
            found |= (self.sequence == name) & (self.end >= first) & (self.frame <= last)
        return found


_OF_FRAMES = ("sequence", "frame", "end", "segment", "fold")


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
    data = labelled_data(study, archive, sets)
    recordings = np.concatenate([np.full(len(s.known), s.recording) for s in data.sequences])
    several = len(data.recordings) >= MIN_RECORDINGS
    fold = np.unique(recordings, return_inverse=True)[1] if several else data.segments()
    return Scenario(
        np.concatenate([np.full(len(s.known), s.name) for s in data.sequences]),
        np.concatenate([s.known for s in data.sequences]),
        np.concatenate([s.ends for s in data.sequences]),
        data.segments(),
        fold,
        np.concatenate([s.seconds for s in data.sequences]),
        np.concatenate([s.positions for s in data.sequences]),
        np.concatenate([s.descriptors for s in data.sequences]),
        data.errors(),
        dict(data.sequences[0].blocks),
        sets,
        np.array([data.costs.alone(n) for n in numbers]),
        _candidates(study, numbers),
    )


def _candidates(study: OfflineStudy, numbers: Sequence[int]) -> tuple[int, ...]:
    """Those of some trials that `online` lets a rule select; all before there is a model."""
    if not study.model_path.exists():
        return tuple(numbers)
    model = ErrorModel.load(study.model_path)
    some: Collection[int] = model.allowed() or model.sets
    if study.mechanism == "bank" and not study.odometry.description.live:
        some = [trial for trial in model.bank if trial not in model.reserve]
    return tuple(n for n in numbers if n in {model.fixed, *some})


def write_scenario(path: Path | str, found: Scenario) -> Path:
    """Write the table as CSV or Parquet, and beside it the sets, to the file that is returned."""
    path = Path(path)
    columns = found.columns()
    if path.suffix == ".parquet":
        with replacing(path) as temporary:
            _pandas(path).DataFrame(columns).to_parquet(temporary)
    else:
        rows = zip(*columns.values(), strict=True)
        write_text(path, csv_text([dict(zip(columns, row, strict=True)) for row in rows]))
    known = [
        {"trial": n, "cost": cost if np.isfinite(cost) else None, "parameters": found.sets[n]}
        for n, cost in zip(found.sets, found.cost, strict=True)
    ]
    about = {"blocks": found.blocks, "space": found.sets.space.dump(), "sets": known}
    about |= {"candidates": found.candidates}
    write_text(_sets_path(path), json.dumps(about, indent=1))
    return _sets_path(path)


def read_scenario(path: Path | str) -> Scenario:
    """Read what `write_scenario` wrote; an AdaptuneError says that it is no such table."""
    path = Path(path)
    try:
        columns, about = _columns(path), json.loads(_sets_path(path).read_text("utf-8"))
        sets, numbers = about["sets"], range(sum(about["blocks"].values()))
        trials, costs, parameters = (
            [one[key] for one in sets] for key in ("trial", "cost", "parameters")
        )
        features, errors = (
            np.stack([columns[f"{kind}_{i}"] for i in which], axis=1)
            for kind, which in (("feature", numbers), ("rte", trials))
        )
        frame, end, segment, fold = (columns[name].astype(np.intp) for name in _OF_FRAMES[1:])
        return Scenario(
            columns["sequence"].astype(str),
            frame,
            end,
            segment,
            fold,
            columns["time"].astype(float),
            np.stack([columns[axis].astype(float) for axis in "xyz"], axis=1),
            features.astype(np.float32),
            errors.astype(np.float32),
            about["blocks"],
            ParameterSets(load_space(about["space"]), tuple(trials), tuple(parameters)),
            np.array(costs, float),
            tuple(about["candidates"]),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        both = f"{path}, with {_sets_path(path).name} beside it"
        raise AdaptuneError(f"{both}: is no table of errors: {error}") from error


def _sets_path(path: Path) -> Path:
    return path.with_name(f"{path.stem}_sets.json")


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
