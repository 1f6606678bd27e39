"""Whether samplers search better than chance.

    python benchmarks/samplers.py functions
    python benchmarks/samplers.py table
    python benchmarks/samplers.py thesis PICTURE.png [ODOMETRY ...]

*functions*: annealing and TPE against random search at equal budget, 96 trials and 20 seeds, on
Branin (2 parameters), Ackley (4) and Hartmann (6); the baseline is a random point. *table*: the
same on trials of GICP, recorded beforehand on a dense grid over a simulated course; a set counts as
its nearest neighbour on the grid. Both print the median of the best value, the number of seeds that
are better than random, and the one-sided p of Wilcoxon's signed-rank test over the seeds. The
samplers' defaults were chosen on other functions (Rosenbrock, Levy, Styblinski-Tang, Griewank).

*thesis*: the experiment of Tavares (2026) in small. Grid, random, annealing and TPE tune GICP and
evalio's KISS-ICP on a simulated garden by RTE, 17 trials (the defaults and a grid of 4 x 4) and
five seeds; the table shows the best RTE and RPE among a search's trials, as the median over the
seeds, and the curves are drawn. Both simulations are of 25 m, which is short.
"""

import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.stats import wilcoxon

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

from made_drives import trials_of

from adaptune._system import machine
from adaptune.report import tables
from adaptune.report.charts import Axis, Band, Chart, Drawn, Line, Panel
from adaptune.report.drawing import draw_chart
from adaptune.runs.archive import Frames
from adaptune.simulation.record import record
from adaptune.space import Categorical, Float, ParameterSet, ParameterSpace
from offline.config import OfflineConfig, load_study
from offline.drive import TrialSetup
from offline.frames import describe
from offline.samplers import Sampler, make_sampler

TRIALS = 96
SEEDS = range(20)
SIDE = 32
"""Points of the recorded grid along each parameter, closer than annealing's steps are long."""
THESIS = {
    "gicp": [],
    "evalio_kiss_icp": [
        "odometry.settings={}",
        "isolation.seconds=100",
        "odometry.parameters={voxel_size: {}, initial_threshold: {}}",
    ],
}
"""Odometries, and what is overridden for them."""
THESIS_TRIALS = 17
THESIS_SEEDS = range(5)

Error = Callable[[ParameterSet], float]


def branin(x: NDArray[np.float64]) -> float:
    """Least value 0.398."""
    a, b = 15 * x[0] - 5, 15 * x[1]
    valley = b - 5.1 / (4 * np.pi**2) * a**2 + 5 / np.pi * a - 6
    return float(valley**2 + 10 * (1 - 1 / (8 * np.pi)) * np.cos(a) + 10)


def ackley(x: NDArray[np.float64]) -> float:
    """Least value 0, away from the middle."""
    z = 40 * (x - 0.63)
    hills = np.exp(np.mean(np.cos(2 * np.pi * z)))
    return float(20 - 20 * np.exp(-0.2 * np.sqrt(np.mean(z**2))) + np.e - hills)


_A = np.array(
    [
        [10, 3, 17, 3.5, 1.7, 8],
        [0.05, 10, 17, 0.1, 8, 14],
        [3, 3.5, 1.7, 10, 17, 8],
        [17, 8, 0.05, 10, 0.1, 14],
    ]
)
_P = 1e-4 * np.array(
    [
        [1312, 1696, 5569, 124, 8283, 5886],
        [2329, 4135, 8307, 3736, 1004, 9991],
        [2348, 1451, 3522, 2883, 3047, 6650],
        [4047, 8828, 8732, 5743, 1091, 381],
    ]
)


def hartmann(x: NDArray[np.float64]) -> float:
    """Least value 0.078, which is 3.4 added to that of the literature."""
    wells = np.exp(-np.sum(_A * (x - _P) ** 2, axis=1))
    return float(3.4 - np.array([1.0, 1.2, 3.0, 3.2]) @ wells)


def best_so_far(
    space: ParameterSpace, error: Error, sampler: str, seed: int
) -> NDArray[np.float64]:
    """Best error after every trial of one search."""
    config = OfflineConfig(sampler=sampler, seed=seed)
    search = make_sampler(space, config)
    return np.minimum.accumulate([error(one) for one in proposed(search, error, TRIALS)])


def proposed(search: Sampler, error: Error, n: int) -> list[ParameterSet]:
    """The sets of a search, each with the results of all trials but the last ones before it."""
    sets: list[ParameterSet] = []
    values: list[float] = []
    while len(sets) < n:
        seen = max(0, len(sets) - search.config.batch + 1)
        found = search.propose(list(zip(sets, values, strict=True))[:seen], sets[seen:])
        if found is None:
            break
        sets.append(found.parameters)
        values.append(error(found.parameters))
    return sets


def against_random(
    name: str,
    spaces: Callable[[int], ParameterSpace],
    error: Error,
) -> None:
    """Print a row for each sampler."""
    best = {
        sampler: np.array([best_so_far(spaces(seed), error, sampler, seed)[-1] for seed in SEEDS])
        for sampler in ("random", "annealing", "tpe")
    }
    for sampler, found in best.items():
        wins = ""
        if sampler != "random":
            p = wilcoxon(found, best["random"], alternative="less", zero_method="zsplit").pvalue
            wins = f"{(found < best['random']).sum():6d} of {len(SEEDS)}   p {p:.1e}"
        print(f"{name:12} {sampler:10} {np.median(found):9.4f} {wins}", flush=True)


def functions() -> None:
    """Compare on the test functions."""
    for function, n in ((branin, 2), (ackley, 4), (hartmann, 6)):

        def spaces(seed: int, n: int = n) -> ParameterSpace:
            at = np.random.default_rng((seed, 99)).random(n)
            return ParameterSpace(
                {f"x{i}": Float(low=0.0, high=1.0, baseline=float(at[i])) for i in range(n)}
            )

        def error(s: ParameterSet, function: Any = function) -> float:
            value: float = function(np.array(list(s.values())))
            return value

        against_random(function.__name__, spaces, error)


STUDY = """\
odometry: {name: gicp, settings: {downsampling: 0.5, min_range: 1.0, iterations: 20}}
courses: {course: {scenes: [garden], length: 25, columns: 512, seed: 1}}
training: [course]
sub_trajectory: 10.0
"""


def prepare(folder: Path, *overrides: str) -> tuple[TrialSetup, Frames]:
    """Simulate the course, if it is not there yet, and prepare it for an odometry."""
    file = folder / "samplers.yaml"
    file.write_text(STUDY)
    study = load_study(file, overrides, folder / "run")
    if not study.sequences.recording("course").exists():
        record(study.config.courses["course"], study.sequences.recording("course"))
    setup = TrialSetup(study.config, study.odometry, study.sequences)
    return setup, describe(study.config, study.sequences, "course")


def table(folder: Path) -> None:
    """Compare on recorded trials of GICP."""
    setup, frames = prepare(folder)
    space = setup.odometry.space
    unit = (np.arange(SIDE) + 0.5) / SIDE
    points = np.stack(np.meshgrid(*[unit] * len(space), indexing="ij"), -1).reshape(-1, len(space))
    trials = trials_of(setup, space.from_unit(points), "course", frames, memory=8e9)
    errors = np.array([trial.mean_error for trial in trials])
    print(f"table: {len(errors)} trials, {errors.min():.3f} to {errors.max():.3f} %", flush=True)

    def error(s: ParameterSet) -> float:
        (at,) = space.to_unit([s])
        return float(errors[np.argmin(((points - at) ** 2).sum(axis=1))])

    against_random("table", lambda _: space, error)


def searches(folder: Path, name: str) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Rows of the thesis's table for an odometry, and the curves of each sampler."""
    setup, frames = prepare(folder, f"odometry.name={name}", *THESIS[name])
    known: dict[str, tuple[float, float]] = {}

    def measures(s: ParameterSet) -> tuple[float, float]:
        if repr(s) not in known:
            (trial,) = trials_of(setup, [s], "course", frames, memory=8e9)
            known[repr(s)] = trial.mean_error, trial.metrics["rpe"]
        return known[repr(s)]

    base = measures(setup.odometry.space.baseline)
    rows: list[dict[str, Any]] = [{"": name, "sampler": "defaults", "RTE %": base[0]}]
    rows[0] |= {"RTE change": "", "RPE m": base[1], "RPE change": ""}
    curves: dict[str, Any] = {}
    side = round((THESIS_TRIALS - 1) ** (1 / len(setup.odometry.space)))
    axes = {
        n: {"low": p.low, "high": p.high, "count": side}
        for n, p in setup.odometry.space.parameters.items()
        if not isinstance(p, Categorical)
    }
    for sampler in ("grid", "random", "annealing", "tpe"):
        best = []
        for seed in THESIS_SEEDS:
            search = make_sampler(
                setup.odometry.space,
                OfflineConfig(
                    sampler=sampler,
                    sampler_settings={"grid": axes} if sampler == "grid" else {},
                    seed=seed,
                    initial=6,
                    batch=2,
                ),
            )
            sets = proposed(search, lambda s: measures(s)[0], THESIS_TRIALS)
            best.append([measures(s) for s in sets])
            print(f"{name}: {sampler}, seed {seed}", file=sys.stderr, flush=True)
        curves[sampler] = np.minimum.accumulate(np.array(best), axis=1)
        rte, rpe = np.median(curves[sampler][:, -1], axis=0)
        rows.append(
            {
                "": name,
                "sampler": sampler,
                "RTE %": rte,
                "RTE change": f"{rte / base[0] - 1:+.1%}",
                "RPE m": rpe,
                "RPE change": f"{rpe / base[1] - 1:+.1%}",
            }
        )
    return rows, curves


def thesis(folder: Path, png: Path, names: list[str]) -> None:
    """Print the table, and draw the curves."""
    console = Console(width=100)
    panels = []
    x, y = Axis("trial [-]"), Axis("best RTE over 10 m [%]", log=True)
    for name in names:
        rows, curves = searches(folder, name)
        console.print(tables.table(f"{name}, {THESIS_TRIALS} trials", rows))
        drawn: list[Drawn] = []
        for sampler, curve in curves.items():
            n, errors = np.arange(curve.shape[1]), curve[..., 0]
            drawn.append(Band(n, errors.min(axis=0), errors.max(axis=0), sampler))
            drawn.append(Line(n, np.median(errors, axis=0), sampler))
        panels.append(Panel(x, y, tuple(drawn), name))
    title = f"Median and range over {len(THESIS_SEEDS)} seeds"
    draw_chart(Chart("samplers", title, tuple(panels), columns=2), png, png.with_suffix(".svg"))


if __name__ == "__main__":
    machine.pin(0)
    what, *more = sys.argv[1:] or [""]
    with tempfile.TemporaryDirectory() as made:
        if what == "functions":
            functions()
        elif what == "table":
            table(Path(made))
        elif what == "thesis" and more:
            thesis(Path(made), Path(more[0]), more[1:] or list(THESIS))
        else:
            sys.exit(__doc__)
