"""What the online stage costs in time, against the odometry alone.

    python benchmarks/real_time.py [--seconds 60]

ADAPTUNE_TEST_DATA names the folder of the recordings. Run it on a machine of two cores or more on
which nothing else runs. It prints

- lockstep: a replay of `street.bag` from the decoded cache over reading, preparing and aligning
  alone (limit 1.1), with one set, and with one set that is adapted live (limit 1.03 of that);
- cores: a bank of four on two cores over one instance on one (limit 1.6), GICP with one
  downsampling, scans of an HDL-32E;
- real time: at 10 Hz with scans of an HDL-64E, one GICP and the selector on two cores: from scan to
  parameters (limit 20 ms at the 99th percentile), and how long the odometry waited for it (limit
  10 ms).

Each ratio is the median of five, the two taken in turn.
"""

import argparse
import os
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np

from adaptune._system import machine
from adaptune.bank.bank import Bank
from adaptune.model import ErrorModel
from adaptune.model.descriptor import lowest_elevation
from adaptune.model.ndt import N_FEATURES, ndt_histogram
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.remote import Limits
from adaptune.recording.config import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.recording.scan import Scan
from adaptune.runs.loop import replay
from adaptune.selector import Selector, untrained_sets
from adaptune.simulation import Course
from adaptune.simulation.record import simulate
from adaptune.space import ParameterSets, ParameterSpace
from adaptune.study.config import RealTimeConfig
from online.real_time import replay_in_real_time
from online.selector_process import SelectorProcess

REPEATS = 5
SETTINGS = {"downsampling": 0.5}
SPACE = ParameterSpace(
    {n: p for n, p in KeyframeGicp.space.parameters.items() if n != "downsampling"}
)
GICP = OdometryFactory("gicp", SETTINGS, SPACE, Limits())
SETS = untrained_sets(SPACE, 4)


def compared(one: Callable[[], object], other: Callable[[], object]) -> tuple[float, float]:
    """Seconds that one takes, and how many times as long the other does."""
    seconds = []
    for _ in range(REPEATS):
        pair = []
        for run in (one, other):
            begin = time.perf_counter()
            run()
            pair.append(time.perf_counter() - begin)
        seconds.append(pair)
    return float(np.median([a for a, _ in seconds])), float(np.median([b / a for a, b in seconds]))


def bare(scans: Iterable[Scan]) -> None:
    """Read, prepare and align, and nothing else."""
    odometry = KeyframeGicp(settings=KeyframeGicp.settings_type(**SETTINGS))
    for i, scan in enumerate(scans):
        prepared = odometry.prepare(scan)
        if i:
            odometry.register(prepared)
        else:
            odometry.start(prepared, np.eye(4))


def single(scans: Iterable[Scan]) -> None:
    """Replay with one instance."""
    replay(scans, GICP(), HealthCheck())


def of_four(scans: Iterable[Scan]) -> None:
    """Replay with a bank of four on two cores, and no selector."""
    bank = Bank(GICP, dict(zip(SETS.trials, SETS.parameters, strict=True)), cores=2)
    with closing(bank):
        replay(scans, bank, HealthCheck())


def lockstep(bag: Path) -> None:
    """Compare with the bare odometry."""
    sequence = open_sequence(SequenceConfig(bag=str(bag), points="/velodyne_points"))
    bare(sequence)  # decodes the recording
    seconds, ratio = compared(lambda: bare(sequence), lambda: single(sequence))
    print(f"lockstep: {seconds:.2f} s bare, a replay takes {ratio:.3f} times as long", flush=True)


def spread_bank(scans: list[Scan]) -> None:
    """Compare a bank on two cores with one instance on one."""
    of_four(scans[:20])
    seconds, ratio = compared(lambda: single(scans), lambda: of_four(scans))
    ms = 1e3 * seconds / len(scans)
    print(f"cores: {ms:.1f} ms a scan, a bank of four on two takes {ratio:.2f} times as long")


def model_of(scans: list[Scan], n_sets: int = 16, copies: int = 20) -> ErrorModel:
    """A model of as many frames as training has, with errors of chance."""
    rng = np.random.default_rng(0)
    sets = ParameterSets(
        SPACE, tuple(range(n_sets)), tuple(SPACE.from_unit(rng.random((n_sets, len(SPACE)))))
    )
    described = np.tile([ndt_histogram(scan.points) for scan in scans], (copies, 1))
    n = len(described)
    return ErrorModel(
        odometry={"name": "gicp"},
        sets=sets,
        fixed=0,
        length=25.0,
        sequences=["one", "two"],
        blocks={"ndt": N_FEATURES},
        window=1,
        descriptors=described.astype(np.float32),
        sequence=np.arange(n) * 2 // n,
        errors=rng.gamma(2.0, 0.5, (n, n_sets)).astype(np.float32),
        provenance={},
        elevations=[lowest_elevation(scans[0])] * 2,
    )


def in_real_time(scans: list[Scan]) -> None:
    """Replay at the sensor's rate with a selector."""
    make = partial(Selector, model_of(scans), "adaptive", ())
    with closing(SelectorProcess(make, 1.0)) as selector:
        found = replay_in_real_time(scans, GICP(), HealthCheck(), RealTimeConfig(), selector)
    print(f"real time, {len(scans)} scans: {found.summary.real_time}", flush=True)


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of the replay in real time")
    seconds = parser.parse_args().seconds
    pinned = machine.pin(0, alone=True)
    lockstep(Path(os.environ["ADAPTUNE_TEST_DATA"]) / "street.bag")
    spread_bank(list(simulate(Course(scenes=("street",), length=40.0, seed=1))))
    in_real_time(
        list(simulate(Course(scenes=("street",), length=seconds, sensor="hdl64e", seed=1)))
    )
    pinned.close()


if __name__ == "__main__":
    main()
