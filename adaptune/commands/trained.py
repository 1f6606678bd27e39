"""What is said of a training, beside its own words."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from adaptune.commands.terminal import say, show_table

if TYPE_CHECKING:
    from adaptune.tuning.tuned import Tuned
    from offline.config import OfflineStudy
    from offline.train import Training


def show_front(rows: Sequence[Mapping[str, Any]], title: str, caption: str) -> None:
    """The table of what CPU time buys."""
    shown = [
        {
            "": ("-> " if row["recommended"] else "") + row["what"],
            **{key: row[key] for key in ("cost [ms]", "99 % [ms]", "memory [MB]") if key in row},
            "RTE [%]": row["error [%]"],
            "vs baseline": row["vs baseline"],
            "95 %": None
            if row["low"] is None or row["low"] != row["low"]
            else f"{row['low']:.2f}-{row['high']:.2f}",
            "parameters": row["parameters"],
        }
        for row in rows
    ]
    show_table(title, shown, caption)


BUYS = (
    "What CPU time buys, in training",
    "The arrow marks the fixed set: the best that costs no more than the baseline, or the budget, "
    "if it is better than the baseline by a standard error (two, for a single recording). RTE is "
    "that of whole drives, capped where track is lost; a bank's is of parts left out of training.",
)


def say_untuned(study: "OfflineStudy") -> None:
    """Name the parameters that are not tuned because the user's file does not hold them."""
    from adaptune.odometry.registry import ODOMETRIES, odometry_class

    for own in study.config.odometries.values():
        if own.name in ODOMETRIES and (config := own.settings.get("config")):
            known = odometry_class(own.name).space.names
            if lacking := [name for name in known if name not in study.odometry.space.names]:
                say(f"Not tuned, because {config} does not hold them: {', '.join(lacking)}.")


def say_grown(more: Sequence[str], before: Any, now: Any) -> None:
    """What recordings that were not there before have changed."""
    from adaptune.space import in_words

    changed = "the recommended set is the same as before"
    if before is not None and before != now:
        names = [name for name in now if now[name] != before.get(name)]
        old, new = (in_words({name: of.get(name, "-") for name in names}) for of in (before, now))
        changed = f"recommended is {new} instead of {old}"
    say(f"New in training: {', '.join(more)}; {changed}.")


def say_recordings(tuned: "Tuned") -> None:
    """What the other recordings recommend for each, the worst first; or what a third would add."""
    from adaptune.tuning.tuned import left_out_rows

    rows = left_out_rows(tuned.training, tuned.comparison)
    if len(tuned.training.rows) < 2 or len(rows) < 3:
        say(
            "With three recordings, each would also be left out in turn: the table would say "
            "where the recommended set does worst."
        )
        return
    show_table(
        "Each recording left out, the worst first",
        rows,
        "Recommended is the finalist that the others choose; for the test, the fixed set.",
    )


def say_odometries(study: "OfflineStudy", training: "Training") -> None:
    """Of several odometries, what each gives with its own parameters and tuned, in training."""
    from adaptune.space import ODOMETRY
    from offline.front import COST

    labels = list(study.config.odometries)
    if len(labels) < 2:
        return
    rows = []
    for label in labels:
        mine = [row for row in training.trials if row[ODOMETRY] == label]
        known = [row for row in mine if row["mean"] is not None]
        best = min(known, key=lambda row: row["mean"], default=None)
        rows.append(
            {
                "odometry": label,
                "its own parameters [%]": mine[0]["mean"] if mine else None,
                "tuned [%]": None if best is None else best["mean"],
                COST: None if best is None else best[COST],
            }
        )
    rows.sort(key=lambda row: row["tuned [%]"] if row["tuned [%]"] is not None else float("inf"))
    fixed = training.model.sets[training.model.fixed][ODOMETRY]
    say(
        f"Best odometry in training: {rows[0]['odometry']}. On the test, the fixed set is "
        f"{fixed}'s, the baseline {labels[0]}'s; to see another there, name it alone (--odometry)."
    )
    show_table("RTE of each odometry in training", rows)
