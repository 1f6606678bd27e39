"""What one set at a time saves: by expected errors, and by the number of points.

    python benchmarks/one_set.py runs/density    # after adaptune offline of sets of GICP

Each recording is left out in turn. Once a second one of the sets is chosen, by one of two rules:

- *cheapest*: of the sets whose expected error here is at most so many times the fixed set's, the
  cheapest. Expected is the mean over the nearest training frames of each recording.
- *set point*: the set that leaves the number of points nearest to a set point after downsampling,
  as GenZ-LIO does. Of several set points, the one that is cheapest in training and there no worse
  than the fixed set.

The script prints the error to the fixed set's on what is left out (geometric mean over segments,
and the worst one), and CPU time. A set's cost in a place follows from its number of points there,
by a straight line through the costs of all sets on all recordings. Errors are those of the trials:
a switch costs nothing.
"""

import sys
from pathlib import Path

import numpy as np
import small_gicp
from numpy.typing import NDArray

from adaptune.metrics import cap
from adaptune.model.rules import ERROR_FLOOR, N_FRAMES, SHARPNESS, NearestFrames
from adaptune.runs.archive import Archive
from adaptune.space import ParameterSets
from offline.bank_choice import log_ratios
from offline.config import OfflineStudy, load_study
from offline.labelled import LabelledData, LabelledSequence, labelled_data, periods

Counts = dict[str, NDArray[np.float64]]
"""By sequence, points after downsampling by each set, at the first scan of each period."""


def read(study: OfflineStudy) -> LabelledData:
    """What the trials say."""
    archive = Archive(study.folder / "trials")
    known = {number: run.parameters for number, run in archive.known().items()}
    sets = ParameterSets(study.odometry.space, tuple(known), tuple(known.values()))
    return labelled_data(study, archive, sets).usable()


def count_points(study: OfflineStudy, data: LabelledData) -> Counts:
    """Downsample one scan of each period by each set."""
    cells = [float(p["downsampling"]) for p in data.sets.parameters]
    counts = {}
    for s in data.sequences:
        first = set(s.simulation.stamps[periods(s.simulation.period)[0]].tolist())
        clouds = [scan.points for scan in study.sequences.open(s.name) if scan.stamp in first]
        counts[s.name] = np.array(
            [
                [small_gicp.voxelgrid_sampling(c.astype(float), r).size() for r in cells]
                for c in clouds
            ]
        )
    return counts


def cost_line(study: OfflineStudy, data: LabelledData, counts: Counts) -> NDArray[np.float64]:
    """Milliseconds a scan, and a point, that fit the costs of all sets on all recordings."""
    archive = Archive(study.folder / "trials")
    finished = {s.name: archive.finished(s.name) for s in data.sequences}
    ms = [[finished[s.name][t].ms for t in data.sets] for s in data.sequences]
    points = [counts[s.name].mean(axis=0) for s in data.sequences]
    x, y = np.ravel(points), np.ravel(ms)
    line = np.polynomial.Polynomial.fit(x, y, 1).convert().coef
    left = np.std(y - line[0] - line[1] * x)
    print(
        f"a scan costs {line[0]:.1f} ms and {1e3 * line[1]:.2f} ms a thousand points, +-{left:.1f}"
    )
    return np.asarray(line)


def cheapest(
    left_out: LabelledSequence, others: LabelledData, fixed: int, costs: NDArray[np.float64]
) -> dict[float, NDArray[np.intp]]:
    """Columns chosen in each period, by the most that an expected error may be."""
    data, pca = others.training_data()
    first, _ = periods(left_out.simulation.period)
    features = pca.transform(left_out.simulation.descriptors[first])
    near = NearestFrames(N_FRAMES).fit(data.features, data.sequence).near(features)
    means = near.means(cap(data.errors)) + ERROR_FLOOR
    ratios = means / means[..., [fixed]]
    expected = np.einsum("qs,qsj->qj", near.weights(SHARPNESS), ratios)
    return {
        most: np.where(expected <= most + 1e-9, costs, np.inf).argmin(axis=1)
        for most in (1.0, 1.05, 1.1)
    }


def at_set_point(counts: NDArray[np.float64], points: float) -> NDArray[np.intp]:
    """Columns whose number of points is nearest, in each period."""
    return np.asarray(np.abs(np.log(counts / points)).argmin(axis=1))


class Outcome:
    """Errors and costs of a rule, on one sequence after the other."""

    def __init__(self) -> None:
        self.logs: list[float] = []
        self.costs: list[float] = []
        self.saved: list[float] = []

    def add(
        self, s: LabelledSequence, chosen: NDArray[np.intp], fixed: int, ms: NDArray[np.float64]
    ) -> None:
        """Add a sequence; `ms` is of shape (n_periods, n_sets)."""
        _, period = periods(s.simulation.period)
        clipped, period = cap(s.errors), period[s.known]
        errors = clipped[np.arange(len(clipped)), chosen[period]]
        self.logs += log_ratios(errors, clipped[:, fixed], s.segment).tolist()
        cost = ms[np.arange(len(ms)), chosen].mean()
        self.costs.append(cost)
        self.saved.append(np.log(cost / ms[:, fixed].mean()))

    def __str__(self) -> str:
        logs = np.exp([np.mean(self.logs), np.max(self.logs), np.mean(self.saved)])
        return f"error {logs[0]:.3f} (worst {logs[1]:.2f}), cost {logs[2]:.3f}"


def main() -> None:
    """Leave each recording out."""
    study = load_study(Path(sys.argv[1]) / "study.yaml", folder=Path(sys.argv[1]), needed=False)
    data = read(study)
    counts = count_points(study, data)
    line = cost_line(study, data, counts)
    ms = {name: line[0] + line[1] * of for name, of in counts.items()}
    set_points = np.geomspace(500, 8000, 13)
    for trial in data.sets:
        fixed, outcomes = data.sets.column(trial), dict[str, Outcome]()

        def outcome(name: str, known: dict[str, Outcome] = outcomes) -> Outcome:
            return known.setdefault(name, Outcome())

        for left_out, others in data.folds(by_recording=True):
            name = left_out.name
            costs = np.concatenate([ms[s.name] for s in others.sequences]).mean(axis=0)
            for most, chosen in cheapest(left_out, others, fixed, costs).items():
                outcome(f"cheapest, at most {most}").add(left_out, chosen, fixed, ms[name])
            trained = {points: Outcome() for points in set_points}
            for points, of in trained.items():
                for s in others.sequences:
                    of.add(s, at_set_point(counts[s.name], points), fixed, ms[s.name])
            sound = {p: np.mean(of.saved) for p, of in trained.items() if np.mean(of.logs) <= 0.0}
            best = min(sound, key=sound.__getitem__, default=None)
            column = np.full(len(ms[name]), fixed)
            chosen = column if best is None else at_set_point(counts[name], best)
            outcome("set point, as trained").add(left_out, chosen, fixed, ms[name])
            for points in set_points[::2]:
                chosen = at_set_point(counts[name], points)
                outcome(f"set point, {points:.0f}").add(left_out, chosen, fixed, ms[name])
            for other in data.sets:
                alone = np.full(len(ms[name]), data.sets.column(other))
                outcome(f"always trial {other}").add(left_out, alone, fixed, ms[name])
        mean = np.mean([cap(s.errors)[:, fixed].mean() for s in data.sequences])
        print(f"\nfixed: trial {trial}, {data.sets[trial]}: {mean:.3f} %")
        for name, of in outcomes.items():
            print(f"  {name:24s} {of}")


if __name__ == "__main__":
    main()
