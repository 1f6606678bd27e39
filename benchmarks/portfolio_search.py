"""Whether a search that begins with a portfolio finds better sets than one that does not.

    python benchmarks/portfolio_search.py FOLDER [--odometry gicp] [--trials 32] [--seeds 0]
                                                 [--recordings hall ...] [--untrained]

ADAPTUNE_TEST_DATA names the folder of the recordings. On the first 60 % of each, `offline` searches
as `tune` does, with the portfolio that is chosen without the recording's sensor, by the tables that
`portfolio.py` made, and without any. The fixed sets are replayed along the last 40 %. The script
prints the ratios of their errors to the baseline's, and of both; FOLDER receives ``searches.csv``.
The same command resumes.

With --untrained, banks without a model are replayed along whole recordings instead.
"""

import argparse
import os
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from portfolio import TABLES, as_text, left_out, portfolio, within_budget, written
from portfolio_data import OF_RECORDINGS, Place, read_places, sets_of
from recorded import CARS, RECORDINGS, Direction, definition

from adaptune._system import machine, yaml12
from adaptune._system.files import write_text
from adaptune._system.progress import unseen
from adaptune.metrics import cap
from adaptune.odometry.portfolio import read_portfolio
from adaptune.report import tables
from adaptune.study.references import ensure_references
from offline.config import OfflineStudy, load_study
from offline.train import train
from online.modes import BASELINE, FIXED, UNTRAINED, Replays, replay_modes
from online.reference import read_reference

WITH, WITHOUT = "portfolio", "none"


def written_without(place: Place, places: list[Place], odometry: str, n: int, path: Path) -> str:
    """Write the portfolio that is chosen without a sensor; its file and digest for a study."""
    make = partial(portfolio, n=n, objective=within_budget)
    chosen = left_out(place, places, sensor=True, choose_sets=make)
    made = written(odometry, places, sets_of(odometry, len(place.costs)), chosen)
    write_text(path, as_text(made))
    return read_portfolio(str(path)).digest


def study_of(given: argparse.Namespace, name: str, begun: Mapping[str, str], seed: int) -> Any:
    """The study of a recording."""
    roles = ((name,), ()) if given.untrained else ((f"{name}: 0-60%",), (f"{name}: 60-100%",))
    direction = Direction(*roles, RECORDINGS[name])
    defined = definition(direction, given.odometry, 0, seed, name in CARS)
    search = {"trials": given.trials, "seed": seed, "workers": 1, "portfolio": dict(begun)}
    which = "untrained" if given.untrained else str(seed)
    folder = given.folder / f"{name}-{which}-{WITH if begun else WITHOUT}"
    write_text(path := folder.with_suffix(".yaml"), yaml12.dump(defined | {"offline": search}))
    return load_study(path, folder=folder)


def errors_of(study: OfflineStudy, name: str, mode: str) -> tuple[float, float]:
    """Mean RTE of a mode, and what it costs, in milliseconds of CPU time a scan."""
    replayed = Replays.of(study).read(name, mode)
    errors = read_reference(study, name).errors(replayed.trajectory)
    return float(np.nanmean(cap(errors))), replayed.summary.cpu_ms or np.nan


def row_of(given: argparse.Namespace, name: str, begun: Mapping[str, str], seed: int) -> Any:
    """What a search, or a bank without a model, gives on a recording."""
    study = study_of(given, name, begun, seed)
    mode, fitted = UNTRAINED, None
    if given.untrained:
        study.open()
        ensure_references(study.sequences, study.training, study.config.sub_trajectory)
    else:
        trained, mode = train(study), FIXED
        fitted = trained.model
    tested = study.training[0] if given.untrained else study.config.test[0]
    replay_modes(study, [tested], (BASELINE, mode), unseen, fitted)
    (base, own), (error, ms) = (errors_of(study, tested, one) for one in (BASELINE, mode))
    study.close()
    row = {"recording": name, "seed": seed, "begun with": WITH if begun else WITHOUT}
    row |= {"baseline [%]": base, "error [%]": error, "ratio": error / base, "cost": ms / own}
    return row


def main() -> None:
    """Search on each recording, and print what came of it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--odometry", default="gicp")
    parser.add_argument("--trials", type=int, default=32)
    parser.add_argument("--size", type=int, default=6)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--recordings", nargs="+", default=list(OF_RECORDINGS))
    parser.add_argument("--untrained", action="store_true")
    given = parser.parse_args()
    if "ADAPTUNE_TEST_DATA" not in os.environ:
        sys.exit("ADAPTUNE_TEST_DATA does not name the folder of the recordings")
    machine.pin(os.getpid())
    given.folder.mkdir(parents=True, exist_ok=True)
    places, rows = read_places(TABLES / f"{given.odometry}-errors.csv"), []
    for name in given.recordings:
        place = next(place for place in places if place.name == name)
        path = (given.folder / f"without-{place.sensor}.yaml").resolve()
        begun = {str(path): written_without(place, places, given.odometry, given.size, path)}
        for seed in given.seeds:
            for first in (begun, {}):
                rows.append(row := row_of(given, name, first, seed))
                print(
                    *(f"{x:.3g}" if isinstance(x, float) else x for x in row.values()), flush=True
                )
        tables.write_rows(given.folder, "untrained" if given.untrained else "searches", rows)
    of = {how: [row for row in rows if row["begun with"] == how] for how in (WITH, WITHOUT)}
    logs = {how: np.log([row["ratio"] for row in some]) for how, some in of.items()}
    for how, log in logs.items():
        cost = np.exp(np.mean(np.log([row["cost"] for row in of[how]])))
        print(f"{how}: {np.exp(log.mean()):.2f}, worst {np.exp(log.max()):.2f}, cost {cost:.2f}")
    print(f"difference of logarithms: {(logs[WITH] - logs[WITHOUT]).mean():+.2f}")


if __name__ == "__main__":
    main()
