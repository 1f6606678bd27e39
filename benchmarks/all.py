"""All figures of speed and size, and the table docs/benchmarks.md.

    python benchmarks/all.py FOLDER [--only NAME ...] [--quick] [--table FILE]

Runs the other benchmarks one after the other, two hours on an idle machine of two cores, and keeps
what each prints in FOLDER. What is there is not run again: remove a log to measure anew. The table
has the figures of all logs in FOLDER, with what each is compared with, and its limit. What needs
recorded data is left out where ADAPTUNE_TEST_DATA names no folder. `--quick` measures on little:
such figures tell that everything runs, and nothing else.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
TABLE = HERE.parent / "docs/benchmarks.md"


class Figure(NamedTuple):
    """A number in what a benchmark prints."""

    what: str
    against: str  # what it is compared with
    pattern: str  # finds it; of several numbers the worst counts
    unit: str = ""  # a ratio without
    limit: float | None = None
    least: bool = False  # whether it must not be less than the limit, rather than not more


class Benchmark(NamedTuple):
    """A benchmark, and its figures."""

    arguments: list[str]
    quick: list[str]  # arguments that measure on little
    figures: list[Figure]
    recorded: bool = False  # whether it needs recorded data


N = r"(\d+(?:\.\d+)?)"
READ = "rosbags and one copy of each field"
BARE = "a bare loop of read, prepare and align"
BENCHMARKS = {
    "reading": Benchmark(
        ["reading.py", "--large", "10"],
        ["reading.py", "--scans", "20"],
        [
            Figure("a cloud of 29,000 points decoded", "", rf"decode .*? {N} ms", "ms", 0.3),
            Figure("bag to clouds", READ, rf"uncompressed .* {N} of the least", "", 1.15),
            Figure("bag to clouds, LZ4", READ, rf"LZ4 .* {N} of the least", "", 1.15),
            Figure("10,000 cached scans opened", "", rf"to the first .*? {N} ms", "ms", 200),
            Figure("memory of a pass over 10 GB", "", rf"over 10 GB .*? {N} MB", "MB", 500),
        ],
    ),
    "inspecting": Benchmark(
        ["inspecting.py"],
        ["inspecting.py", "--chunks", "200", "--gigabytes", "0.2"],
        [Figure("`inspect` of 80 GB", "", rf"{N} s \(limit 3 s\)", "s", 3)],
    ),
    "campaign": Benchmark(
        ["campaign.py", "speed"],
        ["campaign.py", "speed", "4", "350"],
        [
            Figure(
                "campaign, one worker", BARE, rf"1 worker .*: {N} times the bare", "", 1.1, True
            ),
            Figure(
                "campaign, two workers", "one worker", rf"2 workers .*: {N} times", "", 1.8, True
            ),
        ],
    ),
    "memory": Benchmark(
        ["campaign.py", "memory"],
        ["campaign.py", "memory", "1"],
        [Figure("memory of a worker", "what it keeps", rf"as it is +{N} times", "", 2)],
    ),
    "size": Benchmark(
        ["campaign.py", "size"],
        ["campaign.py", "size", "200"],
        [Figure("10,000 trials resumed", "", rf"asked for after {N} s", "s", 5)],
    ),
    "selection": Benchmark(
        ["selection.py"],
        ["selection.py"],
        [
            Figure("selection, `paper`", "", rf"paper .* selection: median {N} ms", "ms", 10),
            Figure("selection, `adaptive`", "", rf"adaptive .* selection: median {N} ms", "ms", 5),
            Figure("weights of a bank", "", rf"bank .* selection: median {N} ms", "ms", 5),
            Figure(
                "faster than 256 iterations of TPE",
                "scikit-learn's regressor",
                rf"TPE: .*, {N} times ours",
                "",
                100,
                True,
            ),
            Figure("model of 14,136 frames, 1536 sets", "", rf"file {N} MB", "MB", 100),
            Figure("the model loaded", "", rf"loaded and checked .*CPU {N} s", "s", 1),
        ],
    ),
    "stages": Benchmark(
        ["stages.py", "{data}"],
        ["stages.py", "{data}"],
        [
            Figure("a trial", "a bare loop of align", rf"trial, .* ratio {N}", "", 1.15),
            Figure("an adaptive replay", BARE, rf"adaptive replay .* ratio {N}", "", 1.15),
            Figure("descriptor of 100,000 points", "", rf"descriptor, .*: {N} ms", "ms", 3),
            Figure("RTE of 4541 poses", "", rf"RTE of .*: {N} ms", "ms", 10),
        ],
        recorded=True,
    ),
    "live": Benchmark(
        ["live.py"],
        ["live.py"],
        [Figure("live evidence, HDL-64E", "a core", rf"town.bag +{N}%", "%", 10)],
        recorded=True,
    ),
    "real_time": Benchmark(
        ["real_time.py"],
        ["real_time.py", "--seconds", "4"],
        [
            Figure("a replay in lockstep", BARE, rf"replay takes {N} times", "", 1.1),
            Figure(
                "a bank of four, two cores", "one, one core", rf"on two takes {N} times", "", 1.6
            ),
        ],
        recorded=True,
    ),
    "length": Benchmark(
        ["growth.py", "length"],
        ["growth.py", "length", "60", "120", "--points", "3000"],
        [
            Figure("memory, 20,000 scans", "", rf"memory {N} GB", "GB", 4),
            Figure("a scan of 20,000", "of 1000", rf"takes {N} times as long", "", 1.2),
        ],
    ),
    "members": Benchmark(
        ["growth.py", "members"],
        ["growth.py", "members", "30"],
        [
            Figure(f"a bank of {n}, one core", "one instance", rf"bank of {n}: .*, {N} times one")
            for n in (2, 4, 6)
        ],
    ),
}


def logs(names: list[str], folder: Path, quick: bool) -> None:
    """Run benchmarks of which there is no log."""
    data = os.environ.get("ADAPTUNE_TEST_DATA", "")
    for name in names:
        benchmark, log = BENCHMARKS[name], folder / f"{name}.log"
        if log.exists() or (benchmark.recorded and not data):
            print(f"{name}: {'is there' if log.exists() else 'needs ADAPTUNE_TEST_DATA'}")
            continue
        script, *arguments = benchmark.quick if quick else benchmark.arguments
        command = [sys.executable, str(HERE / script), *(a.format(data=data) for a in arguments)]
        print(f"{name}: {' '.join(command[1:])}", flush=True)
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            sys.exit(f"{name}: ended with {done.returncode}\n{done.stdout}")
        log.write_text(done.stdout)


def rows(folder: Path) -> Iterator[str]:
    """The table's lines, from the logs that are there."""
    for name, benchmark in BENCHMARKS.items():
        log = folder / f"{name}.log"
        text = log.read_text() if log.exists() else ""
        for figure in benchmark.figures:
            found = re.findall(figure.pattern, text)
            if found:
                worst = min if figure.least else max
                yield line(figure, worst(map(float, found)), f"`{benchmark.arguments[0]}`")


def line(figure: Figure, value: float, by: str) -> str:
    """A line of the table."""
    what, against, _, unit, limit, least = figure
    shown = f"{value:g} {unit}" if unit else f"{value:.2f} times"
    bound = ""
    if limit is not None:
        kept = value >= limit if least else value <= limit
        bound = f"at {'least' if least else 'most'} {limit:g}{'' if kept else ', **missed**'}"
    return f"| {what} | {shown} | {against} | {bound} | {by} |"


def machine() -> str:
    """What was measured on."""
    cpu = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    name = cpu[1] if cpu else platform.machine()
    cores = len(os.sched_getaffinity(0))
    return f"{name}, {cores} cores, Python {platform.python_version()}, {datetime.now(UTC):%Y-%m}"


def write_table(folder: Path, table: Path, quick: bool) -> None:
    """Replace the table in the page, below its introduction."""
    page = table.read_text("utf-8") if table.exists() else "# Benchmarks\n\n## Figures\n"
    head = page[: page.index("## Figures")]
    remark = "Measured on little, to see that everything runs.\n\n" if quick else ""
    heads = "| figure | measured | against | limit | script |\n|---|---|---|---|---|\n"
    body = "\n".join(rows(folder))
    table.write_text(f"{head}## Figures\n\n{remark}{machine()}.\n\n{heads}{body}\n", "utf-8")


def main() -> None:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(BENCHMARKS), default=list(BENCHMARKS))
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--table", type=Path, default=TABLE)
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    logs(given.only, given.folder, given.quick)
    write_table(given.folder, given.table, given.quick)
    print(given.table.read_text("utf-8"))


if __name__ == "__main__":
    main()
