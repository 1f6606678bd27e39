"""What selection gains on simulated sequences that were left out.

    python benchmarks/gain.py runs/gain --seeds 10 11    # hours on one core; resumes
    python benchmarks/gain.py runs/gain --seeds 10 --odometries gicp --kinds | --own-error

Each seed is another world of 24 sequences: 4 caves, 4 streets, 4 open, 4 gardens, of 120 m each,
and 8 mixed ones of three scenes, each 0.4 times as long. On all of them keyframe GICP and NDT run
the same parameter sets. One sequence after the other is left out, and the fixed set, the rules and
their settings are fitted on the other 23. The script prints ratios to the fixed set's error. The
rule was worked out on GICP with seeds 0, 4 and 5, and changed after seeds 7 (GICP and NDT), 8 and
9; the bank on GICP with seeds 7, 9, 11 and 12, and NDT with seed 8.
"""

import argparse
import itertools
import os
from pathlib import Path

from gain_data import ODOMETRIES, factory_of, labelled, training_courses, trials
from gain_modes import by_kind, own_errors, validate

from offline.labelled import LabelledData
from offline.validate import BANK_SIZE


def compare(data: LabelledData, arguments: argparse.Namespace) -> None:
    """Leave each sequence out in turn, in the way that is asked for."""
    if arguments.kinds:
        by_kind(data, arguments.bank)
    elif arguments.own_error:
        own_errors(data)
    else:
        validate(data, arguments.bank)


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 11])
    parser.add_argument("--length", type=float, default=120.0, help="metres of a course")
    parser.add_argument("--odometries", nargs="+", default=ODOMETRIES, choices=ODOMETRIES)
    parser.add_argument("--bank", type=int, default=BANK_SIZE, help="members of the bank")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--kinds", action="store_true", help="with a whole kind of scene left out")
    what.add_argument("--own-error", action="store_true", help="how right the own error is")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    # Open3D's NDT differs in its last bits from run to run on more than one core.
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    for seed, odometry in itertools.product(arguments.seeds, arguments.odometries):
        courses = training_courses(seed, arguments.length)
        paths = trials(arguments.folder, odometry, courses, seed)
        data = labelled(paths, factory_of(odometry).space)
        compare(data, arguments)


if __name__ == "__main__":
    main()
