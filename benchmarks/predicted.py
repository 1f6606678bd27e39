"""Whether a bank drives as the bank simulation predicts, course by course.

    python benchmarks/predicted.py runs/gain --seed 43    # after benchmarks/gain.py --seeds 43

Each of the 24 sequences of `benchmarks/gain.py` is left out in turn. On the rest, a bank of four
and its settings are chosen. The script prints the bank's error on what is left out: as it is
predicted from the motions that its members made alone, and as it is when the bank drives there,
with the health check and live evidence. Limit: within 10 % of each other on nine courses of ten.
The last column is the fixed set's error, from its trial.
"""

import os

import numpy as np
from gain_data import factory_of, labelled, training_courses, trials
from replays import bank_of, mean_error, model_of, of_world, replays_of

from adaptune.metrics import cap
from adaptune.simulation.record import simulate
from offline.bank_choice import Policy, bank_errors
from offline.labelled import LabelledData, LabelledSequence

BOUND = 1.1


def predict(sequence: LabelledSequence, others: LabelledData, chosen: Policy) -> float:
    """Mean error of a bank on a sequence that is left out, by its members' recorded motions."""
    fitted = others.training_data()
    errors, _ = next(bank_errors(sequence, others, fitted, chosen.members, [chosen.bank]))
    return float(errors.mean())


def main() -> None:
    """Predict and drive all courses."""
    arguments = of_world(__doc__).parse_args()
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    courses = training_courses(arguments.seed, arguments.length)
    factory = factory_of(arguments.odometry)
    paths = trials(arguments.folder, arguments.odometry, courses, arguments.seed)
    data = labelled(paths, factory.space)
    print(f"{'left out':12}{'predicted':>12}{'driven':>10}{'ratio':>8}{'fixed':>10}   percent")
    ratios = []
    for sequence, others in data.folds():
        model = model_of(arguments.odometry, others)
        chosen, way = bank_of(others, model, factory, 4)
        predicted = predict(sequence, others, chosen)
        scans = list(simulate(courses[sequence.name]))
        (result,) = replays_of(scans, {"bank": way})
        driven = mean_error(scans, result)
        fixed = cap(sequence.errors)[:, data.sets.column(model.fixed)].mean()
        ratios.append(driven / predicted)
        print(
            f"{sequence.name:12}{predicted:12.3f}{driven:10.3f}{ratios[-1]:8.2f}{fixed:10.3f}",
            flush=True,
        )
    apart = np.abs(np.log(ratios))
    print(
        f"geometric mean of driven to predicted {np.exp(np.log(ratios).mean()):.2f}, "
        f"within 10 % on {(apart <= np.log(BOUND)).sum()} of {len(ratios)}, "
        f"half of them within {100 * np.expm1(np.median(apart)):.0f} %"
    )


if __name__ == "__main__":
    main()
