"""The command that says how good trajectories are."""

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from adaptune.commands.online import WORSE, Details, percent
from adaptune.commands.terminal import As, Given, Points, progress, say, show_table

Words = Annotated[
    list[str],
    typer.Argument(
        metavar="BAG... TRAJECTORY...",
        help="Bags; and files of poses, topics, topics of other bags (run2.bag:/odom), or chains "
        "of transforms (/tf:map.base_link).",
        show_default=False,
    ),
]
Place = Annotated[str | None, typer.Option(help="LiDAR in the poses' frame: x y z qx qy qz qw.")]
Offset = Annotated[float, typer.Option(help="Seconds to add to the poses' stamps.")]
Moment = Annotated[Literal["stamp", "end"], typer.Option(help="`end`: poses of scans' ends.")]
Length = Annotated[float | None, typer.Option(help="Metres that errors are measured over.")]
Most = Annotated[str | None, typer.Option("--max", help="Percent; exit with 3 if surely more.")]
Out = Annotated[Path, typer.Option(help="Folder of the page and the tables.", file_okay=False)]


def evaluate(
    words: Words,
    reference: Given = None,
    points: Points = None,
    extrinsic: Place = None,
    clock_offset: Offset = 0.0,
    pose_time: Moment = "stamp",
    sub_trajectory: Length = None,
    most: Most = None,
    reading: As = None,
    out: Out = Path("runs/evaluate"),
    details: Details = False,
) -> None:
    """Say how wrong trajectories are, of any system, with ground truth or without.

    What judges is the recording's own reference, or one that is estimated from its scans, once. Of
    several trajectories, it says which is better, and how surely. Several bags with the same topic
    are a row each, the worst first.
    """
    from adaptune.evaluation.evaluated import evaluate as evaluated
    from adaptune.evaluation.given import parted
    from adaptune.evaluation.shown import tables

    limit = None if most is None else percent(most, "max")
    bags, named = parted(words)
    given: dict[str, Any] = {"reference": reference, "points": points, "reading": reading}
    given |= {"extrinsic": extrinsic, "clock_offset": clock_offset, "pose_time": pose_time}
    with progress() as show:
        found = evaluated(
            bags, *named, sub_trajectory=sub_trajectory, out=out, progress=show, **given
        )
    verdict = "below" if limit is None else found.verdict(limit)
    said = {"above": "Surely above", "below": "Below", "unclear": "TOO LITTLE TO TELL, at"}
    first = [] if limit is None else [f"{said[verdict]} {limit:g} %."]
    for sentence in (*first, *found.words, f"More: {found.page}, and .json, .csv beside it"):
        say(sentence)
    for listing in tables(found.judged, found.pairs)[: None if details else 1]:
        show_table(*listing)
    if verdict == "above":
        raise typer.Exit(WORSE)
