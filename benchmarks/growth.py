"""How costs grow with the length of a recording, and with the members of a bank.

    python benchmarks/growth.py length [SCANS ...] [--points 30000] [--folder SCRATCH]
    python benchmarks/growth.py members [SCANS]

*length* writes bags (1000, 4000 and 20,000 SCANS of as many points) of a robot that drives up and
down a simulated street to a scratch folder, 0.7 MB a scan, and runs a campaign of two trials of
GICP on two workers over each: once, which decodes the bag into the cache, too. It prints the time,
the memory of all processes without the pages of the cache (limit 4 GB), the disk that the cache
takes, and how the time of a scan grows from the shortest bag to the longest (limit 1.2).

*members* drives banks of 1, 2, 4 and 6 GICP with the same preparation along a simulated street of
so many SCANS (200), on one core, and prints CPU time a scan, over that of one instance.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np
from reading import cloud, write

from adaptune._system import machine, yaml12
from adaptune.bank.bank import Bank
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.runs.loop import replay
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from adaptune.trajectory import Trajectory, write_tum

TURN = 200
"""Scans after which the robot goes back."""


def private(root: int) -> float:
    """Megabytes of a process and its descendants, without the pages of files."""
    parents: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents.setdefault(int(fields[1]), []).append(int(stat.parent.name))
    found, waiting = 0.0, [root]
    while waiting:
        process = waiting.pop()
        waiting += parents.get(process, [])
        try:
            lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
        except OSError:
            continue
        found += sum(int(line.split()[1]) for line in lines if line.startswith("Anonymous:"))
    return found / 1e3


def campaign(folder: Path, scans: int, points: int) -> float:
    """Run one over a bag of so many scans, and return its seconds a scan."""
    street = list(islice(simulate(Course(scenes=("street",), length=300.0, seed=1)), TURN))
    street += street[-2:0:-1]
    rng, clouds = np.random.default_rng(0), []
    for scan in street:
        xyz = rng.choice(scan.points, points) + rng.normal(0, 0.01, (points, 3))
        clouds.append(cloud(rng, 0, points, xyz))
    write(folder / "drive.bag", scans, clouds=clouds)
    poses = np.array([street[i % len(street)].T_world_sensor for i in range(scans)])
    stamps = 10**18 + np.arange(scans) * 10**8
    write_tum(folder / "truth.tum", Trajectory(stamps, poses))
    study = {
        "odometry": {"name": "gicp"},
        "sequences": {"drive": {"bag": "drive.bag", "reference": "truth.tum"}},
        "training": ["drive"],
        "sub_trajectory": 5.0,
        "offline": {"trials": 2, "initial": 2, "batch": 2, "workers": 2},
    }
    (folder / "study.yaml").write_text(yaml12.dump(study))
    cache = folder / "cache"
    environment = os.environ | {"ADAPTUNE_CACHE": str(cache)}
    command = [sys.executable, "-m", "adaptune", "offline", "study.yaml"]
    begin, most = time.monotonic(), 0.0
    with (folder / "log").open("w") as log:
        running = subprocess.Popen(command, cwd=folder, env=environment, stdout=log, stderr=log)
        while running.poll() is None:
            most = max(most, private(running.pid))
            time.sleep(0.2)
    seconds = time.monotonic() - begin
    if running.returncode:
        sys.exit((folder / "log").read_text())
    disk = sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
    print(
        f"{scans} scans of {points} points: {seconds:.1f} s, {1e3 * seconds / scans:.1f} ms a "
        f"scan, memory {most / 1e3:.2f} GB, cache {disk / 1e9:.2f} GB",
        flush=True,
    )
    return seconds / scans


def length(sizes: list[int], points: int, scratch: Path | None) -> None:
    """Print what campaigns take over recordings of several lengths."""
    found = []
    if scratch is not None:
        scratch.mkdir(parents=True, exist_ok=True)
    for scans in sizes:
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            found.append(campaign(Path(folder), scans, points))
    print(f"length: a scan takes {found[-1] / found[0]:.2f} times as long in the longest")


def members(scans: int) -> None:
    """Print what banks of several sizes take."""
    machine.pin(0)
    street = list(islice(simulate(Course(scenes=("street",), length=100.0, seed=1)), scans))
    space = odometry_class("gicp").space
    factory = OdometryFactory("gicp", {}, space, Limits())
    spread = np.linspace(0.2, 0.8, 6)
    sets = space.from_unit(np.column_stack([spread] * len(space)))
    sets = [own | {"downsampling": 0.5, "iterations": 20} for own in sets]
    alone = 0.0
    for n in (1, 2, 4, 6):
        with closing(Bank(factory, dict(enumerate(sets[:n])), cores=1)) as bank:
            ms = replay(street, bank, HealthCheck()).cpu_ms
        alone = alone or ms
        print(f"a bank of {n}: {ms:.1f} ms a scan, {ms / alone:.2f} times one", flush=True)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=["length", "members"])
    parser.add_argument("scans", type=int, nargs="*")
    parser.add_argument("--points", type=int, default=30_000)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    if given.what == "length":
        length(given.scans or [1000, 4000, 20_000], given.points, given.folder)
    else:
        members(given.scans[0] if given.scans else 200)


if __name__ == "__main__":
    main()
