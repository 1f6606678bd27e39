"""What tuning and adapting give on recorded data, trained on some recordings, tested on others.

    python benchmarks/recorded.py FOLDER [--odometries gicp ndt kiss_icp] [--sets 16] [--seed 0]
                                         [--directions town campus_1 ...] [--no-reference]
                                         [--also even]

ADAPTUNE_TEST_DATA names the folder of the recordings. Each direction and odometry is a study in
FOLDER: a Sobol sequence of so many sets, one after the other on one core. The same command resumes.
A row is a test sequence: the mean error of each mode in percent, its ratio to the fixed set's, and
95 % intervals of the ratios. *untrained* is a bank that knows nothing of the study.

With --no-reference, training knows no poses: it goes by references that are estimated from the
scans. Errors are still those by the given references. street has none: an estimated one judges it.
--also names modes on demand to replay, too (docs/validate-and-compare.md).

References of town, road and city are a car's GPS and inertial unit: right to about 1 % over 25 m.
Differences below that are no evidence there. hall and campus have other sensors: from one to the
other, adapting can only be expected to do no harm.

FOLDER receives recorded.csv and recorded.json: a row for every study, test sequence and mode that
is there, also of former runs.

    python benchmarks/recorded.py FOLDER --fixed [--sets 24] [--seed 0] [--recordings town road ...]

drives the same sets of GICP along all of each recording, once. Then it chooses the fixed set on
each recording alone, and on all but one, and looks up how it did on the others: error and cost to
the baseline's, by the rule in use and by the least mean error at any cost. Estimated references
judge on the car's drives. FOLDER receives fixed.csv and fixed.json.
"""

import argparse
import json
import os
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from adaptune._system import machine, yaml12
from adaptune._system.files import write_text
from adaptune._system.progress import unseen
from adaptune.errors import AdaptuneError
from adaptune.metrics import cap, sub_trajectory_turns
from adaptune.model.rules import BASELINE, Costs
from adaptune.recording.config import ESTIMATED, part_name, read_part
from adaptune.report import tables
from adaptune.space import ParameterSets
from adaptune.study.config import ALSO
from adaptune.study.references import ensure_references
from offline.campaign import Campaign, run_baseline
from offline.choice import mean_and_error
from offline.config import OfflineStudy, load_study
from offline.labelled import LabelledData, labelled_data
from offline.train import train, trial_workers
from online.modes import Replays, run_replays, run_untrained
from online.reference import read_reference
from online.statistics import ComparisonRow, compare_modes

ODOMETRIES = ("gicp", "ndt", "kiss_icp")
MODES = ("baseline", "fixed", "adaptive", "untrained")
"""What is compared besides the modes on demand."""
CARS = ("town", "road", "city", "street")
# An HDL-64E turns on while the car drives: a scan is distorted by up to two metres. KISS-ICP
# compensates by itself.
COMPENSATING = ("kiss_icp",)
# Keyframes once a second: a gap of 39 s, steps of 1.2 m at most.
CAMPUS = {"health": {"max_speed": 5.0}, "lost_track": 0.5}


@dataclass(frozen=True)
class Direction:
    """Where to tune, and where to test: recordings, or parts of them."""

    training: tuple[str, ...]
    test: tuple[str, ...]
    sub_trajectory: float


DIRECTIONS = {
    "town": Direction(("town",), ("city", "road"), 25.0),
    "city_road": Direction(("city", "road"), ("town",), 25.0),
    "town_city": Direction(("town", "city"), ("road",), 25.0),
    "town_road": Direction(("town", "road"), ("city",), 25.0),
    "cars": Direction(("town", "city", "road"), ("street",), 25.0),
    "campus_1": Direction(("campus: 0-50%",), ("campus: 50-100%",), 25.0),
    "campus_2": Direction(("campus: 50-100%",), ("campus: 0-50%",), 25.0),
    "hall_1": Direction(("hall: 0-50%",), ("hall: 50-100%",), 5.0),
    "hall_2": Direction(("hall: 50-100%",), ("hall: 0-50%",), 5.0),
    "hall": Direction(("hall",), ("campus",), 10.0),
    "campus": Direction(("campus",), ("hall",), 10.0),
}
"""The studies of each odometry: recording to recording, the cars' also with one left out, the
halves of one, and from one sensor to another."""


def definition(
    direction: Direction,
    odometry: str,
    n_sets: int,
    seed: int,
    no_reference: bool = False,
    also: Sequence[str] = (),
) -> dict[str, object]:
    """The study of a direction, as the data of its YAML.

    With `no_reference` it trains on estimated references; those of the test sequences stay. `also`
    are modes on demand.
    """
    training = [sequence(role, odometry, no_reference) for role in direction.training]
    test = [sequence(role, odometry) for role in direction.test]
    given: dict[str, object] = {
        "odometry": {"name": odometry},
        "sequences": dict([*training, *test]),
        "training": [name for name, _ in training],
        "test": [name for name, _ in test],
        "sub_trajectory": direction.sub_trajectory,
        "offline": {"initial": n_sets, "trials": n_sets, "seed": seed, "workers": 1},
        # All modes but `paper`, with a bank, though the benchmark is bound to one core.
        "online": {
            "modes": ["adaptive", *also],
            "switching": {"mechanism": "bank"},
        },
    }
    with_campus = any("campus" in role for role in (*direction.training, *direction.test))
    return given | CAMPUS if with_campus else given


def sequence(role: str, odometry: str, estimated: bool = False) -> tuple[str, dict[str, object]]:
    """Name and entry of a recording, or a part of it, in a study."""
    name, _, part = role.partition(": ")
    entry: dict[str, object] = {"bag": f"${{ADAPTUNE_TEST_DATA}}/{name}.bag"}
    entry |= {"points": "/velodyne_points"}
    # Without poses, a reference is estimated anyway.
    if name != "street":
        entry["reference"] = ESTIMATED if estimated else "/gt_poses"
    if name in CARS and odometry not in COMPENSATING:
        entry["compensate"] = "constant_velocity"
    if name == "campus" and not estimated:
        entry["max_gap"] = 60.0
    if part:
        return part_name(name, read_part(part)), entry | {"part": part}
    return name, entry


def run(study: OfflineStudy, references: Path) -> list[ComparisonRow]:
    """Train, replay in all modes and compare, as far as that was not done before.

    `references` is a folder of estimated references that the studies share.
    """
    own = study.folder / "references"
    if references.exists():
        shutil.copytree(references, own, dirs_exist_ok=True)
    train(study)
    run_replays(study, study.model_path)
    run_untrained(study)
    if own.exists():
        shutil.copytree(own, references, dirs_exist_ok=True)
    rows: list[ComparisonRow] = []
    for name in study.config.test:
        stored = Replays.of(study)
        modes = [m for m in (*MODES, *study.config.online.also) if m in stored.made(name)]
        replays = {mode: stored.read(name, mode) for mode in modes}
        reference = read_reference(study, name)
        rows += compare_modes(name, replays, reference).rows
    return rows


def keep(folder: Path, about: Mapping[str, object], rows: Sequence[ComparisonRow]) -> None:
    """Keep the rows of a study, with what it is about, for `collect`."""
    listed = [{**about, **row.columns()} for row in rows]
    write_text(folder / "rows.json", json.dumps(listed) + "\n")


def collect(folder: Path) -> None:
    """Write the rows of all studies below a folder as ``recorded.csv`` and ``.json``."""
    found = sorted(folder.glob("*/rows.json"))
    rows = [row for path in found for row in json.loads(path.read_text(encoding="utf-8"))]
    keys = dict.fromkeys(key for row in rows for key in row)
    tables.write_rows(folder, "recorded", [{key: row.get(key) for key in keys} for row in rows])


def table_lines(rows: Sequence[ComparisonRow]) -> list[str]:
    """A line for every test sequence: errors and ratios of all modes."""
    lines = []
    for name in dict.fromkeys(row.sequence for row in rows):
        of = [row for row in rows if row.sequence == name]
        cells = [f"  {name:14}"]
        if of[0].reference == ESTIMATED:
            cells.append("by an estimated reference")
        for row in of:
            if row.rte is None or row.ratio is None:
                cells.append(f"{row.mode} unknown")
                continue
            low, high = row.ratio_interval or (np.nan, np.nan)
            times = "" if row.mode == "fixed" else f" = {row.ratio:.2f} ({low:.2f}-{high:.2f})"
            restarts = f", {row.run.restarts} restarts" if row.run.restarts else ""
            cells.append(f"{row.mode} {row.rte:.3f} %{times}{restarts}")
        lines.append("   ".join(cells))
    return lines


def summary(ratios: Mapping[str, Sequence[float]]) -> list[str]:
    """For every mode the geometric mean of its ratios to the fixed set, and the worst."""
    return [
        f"  {mode:10} geometric mean {np.exp(np.mean(np.log(found))):.2f}   worst {max(found):.2f}"
        f"   of {len(found)} test sequences"
        for mode, found in ratios.items()
        if mode != "fixed" and found
    ]


RECORDINGS = {
    **dict.fromkeys((*CARS, "campus", "nuscenes_0006_keyframes"), 10.0),
    **dict.fromkeys(("livox_hku_1", "livox_hku_2", "hall"), 5.0),
}
"""Recordings for `--fixed`, or parts of them, and the metres of their sub-trajectories."""
ALIKE = [CARS, ("livox_hku_1", "livox_hku_2")]
"""Recordings of one sensor on one kind of robot."""


def driven(given: argparse.Namespace, name: str) -> LabelledData:
    """Drive all sets along all of a recording, unless that was done, and read how they did."""
    direction = Direction((name,), (), RECORDINGS[name])
    # Sets differ by less than a car's reference is wrong.
    estimated = given.no_reference or name in CARS
    defined = definition(direction, "gicp", given.sets, given.seed, estimated)
    defined["offline"] = {"initial": given.sets, "trials": given.sets, "seed": given.seed}
    defined["offline"] |= {"segments": "all", "workers": 1}
    folder = given.folder / name.partition(":")[0]
    write_text(path := folder.with_suffix(".yaml"), yaml12.dump(defined))
    study = load_study(path, folder=folder)
    study.open()
    ensure_references(study.sequences, study.training, direction.sub_trajectory)
    archive = study.archive()
    archive.begin()
    with trial_workers(study, study.training, None) as workers:
        run_baseline(study, archive, workers, unseen)
        judged = Campaign(study, archive, workers).run()
    tried = tuple(one.parameters for one in judged.values())
    sets = ParameterSets(study.odometry.space, tuple(judged), tried)
    data = labelled_data(study, archive, sets)
    (one,) = data.sequences
    T_ref_sensor, paths = one.simulation.T_ref_sensor, [archive.read(one.name, n) for n in sets]
    turns = [
        sub_trajectory_turns(T_ref_sensor, path.T_odom_sensor, direction.sub_trajectory)
        for path in paths
    ]
    whole = replace(one, turns=np.stack(turns, axis=1)[one.known])
    return data._replace(sequences=[replace(one, whole=whole)], driven=list(sets))


def together(parts: Sequence[LabelledData]) -> LabelledData:
    """Several recordings as the training sequences of one study, where a set has its mean cost."""
    of_sets = {n: [part.costs.sets[n] for part in parts] for n in parts[0].sets}
    costs = {
        n: of[0]._replace(
            register=float(np.mean([one.register for one in of])),
            prepare=float(np.mean([one.prepare for one in of])),
        )
        for n, of in of_sets.items()
    }
    sequences = [s for part in parts for s in part.sequences]
    return parts[0]._replace(sequences=sequences, costs=Costs(costs, np.nan))


def least_error(data: LabelledData) -> int:
    """Trial number of the set with the least mean error at any cost: the rule of before."""
    blocks = data.blocks()
    means, _ = mean_and_error(blocks.errors, blocks.sequence)
    return blocks.trials[int(np.argmin(np.where(np.isfinite(blocks.restarts), means, np.inf)))]


def fixed_sets(given: argparse.Namespace) -> None:
    """Choose the fixed set on each recording alone and on all but one, and look it up elsewhere."""
    of = {name: driven(given, name) for name in given.recordings}
    rows: list[dict[str, Any]] = []
    trainings = [(name,) for name in of] + [tuple(n for n in of if n != name) for name in of]
    for names in trainings:
        data = together([of[name] for name in names]).usable()
        for rule, trial in (("in use", data.fixed()), ("least error", least_error(data))):
            for test in sorted(set(of) - set(names)):
                (one,), costs = of[test].sequences, of[test].costs
                columns = of[test].sets.columns([trial, BASELINE])
                error, base = cap(one.errors[:, columns]).mean(axis=0).tolist()
                alone = len(names) == 1
                alike = any({*names, test} <= {*those} for those in ALIKE)
                row = {"training": names[0] if alone else "all others", "test": test}
                row |= {"rule": rule, "trial": trial, "alike": alone and alike}
                row |= {"error [%]": error, "baseline [%]": base, "ratio": error / base}
                rows.append(row | {"cost": costs.alone(trial) / costs.alone(BASELINE)})
    tables.write_rows(given.folder, "fixed", rows)
    for training in dict.fromkeys(row["training"] for row in rows):
        print(*fixed_lines(training, [r for r in rows if r["training"] == training]), sep="\n")
    alone = [row for row in rows if row["training"] != "all others"]
    print(*fixed_lines("each alone", alone), sep="\n")
    print(*fixed_lines("each alone, alike", [r for r in alone if r["alike"]]), sep="\n")


def fixed_lines(what: str, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each rule: error and cost to the baseline's, and how often it is kept."""
    lines = []
    for rule in dict.fromkeys(row["rule"] for row in rows):
        mine = [row for row in rows if row["rule"] == rule]
        error, cost = (np.exp(np.mean([np.log(r[key]) for r in mine])) for key in ("ratio", "cost"))
        worst = max(mine, key=lambda row: row["ratio"])
        kept = sum(row["trial"] == BASELINE for row in mine)
        lines.append(
            f"{what:24} {rule:12} error {error:.2f}, worst {worst['ratio']:.2f} on {worst['test']}"
            f"   cost {cost:.2f}   baseline kept {kept} of {len(mine)}"
        )
    return lines


def main() -> None:
    """Run the studies that were asked for, and print what they gave and took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--odometries", nargs="+", default=ODOMETRIES, choices=ODOMETRIES)
    parser.add_argument("--directions", nargs="+", default=list(DIRECTIONS), choices=DIRECTIONS)
    parser.add_argument("--sets", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-reference", action="store_true")
    parser.add_argument("--fixed", action="store_true")
    parser.add_argument("--recordings", nargs="+", default=list(RECORDINGS), choices=RECORDINGS)
    parser.add_argument("--also", nargs="+", default=(), choices=sorted({*ALSO} - {*MODES}))
    given = parser.parse_args()
    if "ADAPTUNE_TEST_DATA" not in os.environ:
        sys.exit("ADAPTUNE_TEST_DATA does not name the folder of the recordings")
    machine.pin(os.getpid())
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.fixed:
        if len(given.recordings) < 2:
            parser.error("--recordings: name two at least")
        fixed_sets(given)
        return
    for odometry in given.odometries:
        ratios: dict[str, list[float]] = {mode: [] for mode in (*MODES, *given.also)}
        for name in given.directions:
            for row in directed(given, odometry, name):
                if row.ratio is not None:
                    ratios[row.mode].append(row.ratio)
        print(f"{odometry}, ratios to the fixed set:", *summary(ratios), sep="\n", flush=True)
    collect(given.folder)


def directed(given: argparse.Namespace, odometry: str, name: str) -> list[ComparisonRow]:
    """Run the study of a direction, print and keep what it gave; no rows if it is not possible."""
    about = {"odometry": odometry, "tuned_on": name, "sets": given.sets, "seed": given.seed}
    stem = "-".join(map(str, about.values())) + ("-no_reference" if given.no_reference else "")
    path, folder = given.folder / f"{stem}.yaml", given.folder / stem
    defined = definition(
        DIRECTIONS[name],
        odometry,
        given.sets,
        given.seed,
        no_reference=given.no_reference,
        also=given.also,
    )
    write_text(path, yaml12.dump(defined))
    begin = time.perf_counter()
    try:
        rows = run(load_study(path, folder=folder), given.folder / "references")
    except AdaptuneError as error:
        print(f"{odometry}, {name}: not possible: {error}", flush=True)
        return []
    print(f"{odometry}, tuned on {name}: {time.perf_counter() - begin:.0f} s")
    print(*table_lines(rows), sep="\n", flush=True)
    keep(folder, about | {"trained_by": ESTIMATED if given.no_reference else "given"}, rows)
    return rows


if __name__ == "__main__":
    main()
