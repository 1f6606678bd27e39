"""Choose a portfolio of parameter sets of an odometry, and say how good it is.

    python benchmarks/portfolio.py FOLDER [--odometry gicp] [--sets 23] [--courses 24]
                                          [--scans 80] [--recordings hall town ...]
    python benchmarks/portfolio.py --odometry gicp    # by the tables that are kept, without driving

The first drives all sets along the courses of a design and along recordings (ADAPTUNE_TEST_DATA
names their folder), once; the same command resumes. Both choose a portfolio greedily: the baseline
first, and each next set lowers the mean over places of the least logarithm of the ratio to the
baseline's error most. Places where no set keeps track do not count.

Each recording is left out in turn, alone or with all places of its sensor, and tested: among the
sets of the portfolio, the rule of `tune` chooses on its first 60 %; errors are of its last 40 %. So
are Sobol's first sets, as many at random, and all of them. The script prints geometric means and
the worst over the recordings, and 95 % intervals of the difference to others' logarithms: over the
recordings, and over their sensors. The same of the best set within the budget in hindsight, on
recordings and courses where some set keeps track.

The tables go to ``benchmarks/portfolio/NAME-errors.csv`` and ``NAME-sets.csv``, the portfolio to
``adaptune/odometry/portfolios/NAME.yaml``.
"""

import argparse
import csv
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from functools import partial
from hashlib import blake2b
from itertools import product
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from portfolio_data import (
    OF_RECORDINGS,
    Place,
    driven_places,
    read_places,
    sets_of,
    write_places,
)
from scipy import stats

from adaptune import __version__
from adaptune._system import machine
from adaptune._system.files import replacing, write_text
from adaptune.metrics import LOST_ABOVE
from adaptune.odometry.portfolio import FOLDER, Member, Portfolio
from adaptune.space import ParameterSet
from offline.choice import EDGE, MOST_OF_PERIOD, USUAL_BUDGET, BlockErrors, choose

TABLES = Path(__file__).parent / "portfolio"
SHARE = 0.6
"""Of a recording, on which is chosen."""
DRAWS = 200
"""Of sets at random."""
BEST = 0.02
"""A member is good for a place where no other has a logarithm lower by more than this."""
PRICE = 0.1
"""Of twice the baseline's cost, as a logarithm of the error, where cost has a price."""


def blocks_of(place: Place, sets: Sequence[int], rows: NDArray[np.bool_]) -> BlockErrors:
    """What some blocks of a place say of some sets."""
    few, errors = list(sets), place.errors[rows]
    none, period = np.zeros(len(errors), np.intp), 1e3 / place.kind.rate
    known = errors[:, few], none, place.costs[few], place.restarts[few], period
    return BlockErrors(few, *known)


def logs_of(places: Sequence[Place]) -> NDArray[np.float64]:
    """Mean logarithms of the ratio to the baseline's error, of shape (n_places, n_sets)."""
    found = []
    for place in places:
        every = blocks_of(place, range(len(place.costs)), np.ones(len(place.errors), bool))
        found.append(np.where(np.isinf(place.restarts), np.inf, every.logs().mean(axis=0)))
    return np.array(found)


def by_error(places: Sequence[Place]) -> NDArray[np.float64]:
    """What is minimised: the error alone."""
    return logs_of(places)


def with_price(places: Sequence[Place]) -> NDArray[np.float64]:
    """The error, and a price on what costs more than the baseline."""
    costs = np.array([place.costs / place.costs[0] for place in places])
    return logs_of(places) + PRICE * np.log2(np.maximum(costs, 1.0))


def within_budget(places: Sequence[Place]) -> NDArray[np.float64]:
    """The error of sets within the usual budget."""
    logs = logs_of(places)
    for row, place in zip(logs, places, strict=True):
        own = place.costs[0]
        most = min(EDGE * USUAL_BUDGET * own, max(MOST_OF_PERIOD * 1e3 / place.kind.rate, own))
        row[place.costs > most] = np.inf
    return logs


Objective = Callable[[Sequence[Place]], NDArray[np.float64]]


def tracked(places: Sequence[Place]) -> list[Place]:
    """Places where some set keeps track."""
    return [place for place in places if place.errors.mean(axis=0).min() <= LOST_ABOVE]


def portfolio(
    places: Sequence[Place], n: int, objective: Objective, of_courses: float = 1.0
) -> list[int]:
    """Choose `n` complementary sets, the baseline first; a course weighs less than a recording."""
    values = objective(known := tracked(places))
    weights = np.array([1.0 if place.recorded else of_courses for place in known])
    chosen, least = [0], values[:, 0]
    while len(chosen) < n:
        means = weights @ np.minimum(values, least[:, None]) / weights.sum()
        means[chosen] = np.inf
        chosen.append(int(np.argmin(means)))
        least = np.minimum(least, values[:, chosen[-1]])
    return chosen


def tested(place: Place, sets: Sequence[int]) -> tuple[float, float]:
    """Ratios to the baseline's error and cost at the end, of what the beginning chooses."""
    ends = np.append(place.begin[1:], 1.0)
    blocks = blocks_of(place, sets, ends <= SHARE + 1e-9)
    trial, test = choose(blocks), place.errors[place.begin >= SHARE].mean(axis=0)
    return float(test[trial] / test[0]), float(place.costs[trial] / place.costs[0])


def in_hindsight(place: Place, sets: Sequence[int]) -> tuple[float, float]:
    """Ratios to the baseline's error and cost of the best of some sets within the usual budget."""
    values = within_budget([place])[0][list(sets)]
    best = list(sets)[int(np.argmin(values))]
    return float(np.exp(values.min())), float(place.costs[best] / place.costs[0])


def left_out(
    place: Place, places: Sequence[Place], sensor: bool, choose_sets: Callable[..., list[int]]
) -> list[int]:
    """A portfolio that is chosen without a place, or without its sensor."""
    return choose_sets(
        [p for p in places if (p.sensor != place.sensor if sensor else p.name != place.name)]
    )


def interval(differences: NDArray[np.float64]) -> str:
    """A mean, with Student's 95 % interval."""
    margin = stats.t.ppf(0.975, len(differences) - 1) * stats.sem(differences)
    mean = differences.mean()
    return f"{mean:+.2f} ({mean - margin:+.2f} to {mean + margin:+.2f})"


def line(
    what: str,
    found: Sequence[tuple[float, float]],
    others: Mapping[str, NDArray[np.float64]],
    sensors: Sequence[str],
) -> str:
    """Geometric means of ratios and costs, the worst ratio, and differences to `others`' logs.

    Intervals are over the recordings, and over their sensors.
    """
    ratios, costs = np.array(found).T
    said = f"{what:42} {np.exp(np.log(ratios).mean()):.2f}; {ratios.max():.2f}"
    said += f"  cost {np.exp(np.log(costs).mean()):.2f}"
    for other, logs in others.items():
        difference = np.log(ratios) - logs
        by_sensor = [difference[np.array(sensors) == s].mean() for s in sorted({*sensors})]
        said += f"  to {other} {interval(difference)}, {interval(np.array(by_sensor))}"
    return said


Judge = Callable[[Place, Sequence[int]], tuple[float, float]]


def evaluate(places: Sequence[Place], tests: Sequence[Place], n: int, judge: Judge) -> None:
    """Print what each choice of candidates gives on the places that test it."""
    n_sets, rng = len(places[0].costs), np.random.default_rng(0)
    sensors = [place.sensor for place in tests]
    sobol = [judge(place, range(n)) for place in tests]
    draws = [[0, *(1 + rng.permutation(n_sets - 1)[: n - 1])] for _ in range(DRAWS)]
    at_random = np.array([[judge(place, few) for place in tests] for few in draws])
    logs = np.log(at_random)
    others = {"Sobol": np.log(np.array(sobol)[:, 0]), "random": logs[..., 0].mean(axis=0)}
    middle = at_random[np.argsort(logs[..., 0].mean(axis=1))[DRAWS // 2]].tolist()
    print(f"{judge.__name__}: {len(tests)} of {len(places)} places, {n} candidates")
    print(line(f"the first {n} of the search", sobol, {}, sensors))
    print(line(f"{n} at random, the median of {DRAWS}", middle, {}, sensors))
    print(line(f"all {n_sets}", [judge(p, range(n_sets)) for p in tests], others, sensors))
    for objective, of_courses in product((by_error, with_price, within_budget), (1.0, 1 / 3, 0.0)):
        for sensor in (False, True):
            make = partial(portfolio, n=n, objective=objective, of_courses=of_courses)
            found = [judge(p, left_out(p, places, sensor, make)) for p in tests]
            what = f"{objective.__name__}, a course {of_courses:.2g}"
            without = "sensor" if sensor else "recording"
            print(line(f"{what}, without the {without}", found, others, sensors))
            each = (f"{p.name} {r:.2f}" for p, (r, _) in zip(tests, found, strict=True))
            print("   ", ", ".join(each), flush=True)


def written(
    odometry: str, places: Sequence[Place], sets: Sequence[ParameterSet], chosen: Sequence[int]
) -> Portfolio:
    """The portfolio with the table by which it was chosen."""
    known = tracked(places)
    logs = logs_of(known)[:, chosen]
    best = logs <= logs.min(axis=1, keepdims=True) + BEST
    members = []
    for k, number in enumerate(chosen):
        cost = np.exp(np.mean([np.log(p.costs[number] / p.costs[0]) for p in known]))
        where = ", ".join(p.name for p, it in zip(known, best[:, k], strict=True) if it)
        good_for = f"{where or 'nothing alone'}; {cost:.1f} times the baseline's cost"
        members.append(Member(parameters=sets[number], good_for=good_for))
    kinds = [place.kind for place in known]
    scans = {
        key: (float(min(values)), float(max(values)))
        for key in ("rate", "points", "view")
        if (values := [float(f"{getattr(kind, key):.3g}") for kind in kinds])
    }
    table = (TABLES / f"{odometry}-errors.csv").read_bytes()
    return Portfolio(
        odometry=odometry,
        sets=tuple(members),
        made=date.today().isoformat(),
        version=__version__,
        tables=blake2b(table, digest_size=8).hexdigest(),
        courses=tuple(p.name for p in known if not p.recorded),
        recordings=tuple(p.name for p in known if p.recorded),
        scans=scans,  # type: ignore[arg-type]
        ratios={
            p.name: tuple(float(f"{x:.3g}") for x in np.exp(row))
            for p, row in zip(known, logs, strict=True)
        },
    )


def as_text(made: Portfolio) -> str:
    """A portfolio as YAML, each set and each row of the table in a line."""
    data = made.model_dump(mode="json")
    return yaml.safe_dump(data, default_flow_style=None, sort_keys=False, width=100)


def main() -> None:
    """Drive what is asked for, evaluate, and write the portfolio."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--odometry", default="gicp")
    parser.add_argument("--sets", type=int, default=23)
    parser.add_argument("--courses", type=int, default=24)
    parser.add_argument("--scans", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, default=6)
    parser.add_argument("--recordings", nargs="*", default=list(OF_RECORDINGS))
    given = parser.parse_args()
    errors, of_sets = (TABLES / f"{given.odometry}-{what}.csv" for what in ("errors", "sets"))
    if given.folder is not None:
        machine.pin(os.getpid())
        places = driven_places(given, given.folder / given.odometry)
        write_places(errors, places)
        rows = sets_of(given.odometry, given.sets)
        with replacing(of_sets) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, ["set", *rows[0]])
            writer.writeheader()
            writer.writerows({"set": i, **row} for i, row in enumerate(rows))
    places = read_places(errors)
    for tests, judge in (
        ([place for place in places if place.recorded], tested),
        (tracked(places), in_hindsight),
    ):
        evaluate(places, tests, given.size, judge)
    sets = sets_of(given.odometry, len(places[0].costs))
    chosen = portfolio(places, given.size, within_budget)
    print("chosen:", *chosen)
    made = written(given.odometry, places, sets, chosen)
    write_text(FOLDER / f"{given.odometry}.yaml", as_text(made))


if __name__ == "__main__":
    main()
