"""The command that watches an odometry of somebody else's."""

import logging
import os
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adaptune.commands.evaluate import Extrinsic, Length, Moment, Offset
from adaptune.commands.terminal import Points, progress, say
from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from online.watch import Told

log = logging.getLogger(__name__)

Bag = Annotated[Path | None, typer.Argument(metavar="[BAG]", help="A recording; none on a robot.")]
Poses = Annotated[
    str, typer.Option(metavar="POSES", help="A topic, a chain of transforms, or a file of poses.")
]
Table = Annotated[Path, typer.Option(help="The table, CSV: a row a second.", dir_okay=False)]
Ros = Annotated[bool, typer.Option("--ros", help="Listen on a robot with ROS 1.")]
Ros2 = Annotated[bool, typer.Option("--ros2", help="Listen on a robot with ROS 2.")]


def watch(
    odometry: Poses,
    bag: Bag = None,
    points: Points = None,
    extrinsic: Extrinsic = None,
    clock_offset: Offset = 0.0,
    pose_time: Moment = "stamp",
    sub_trajectory: Length = None,
    out: Table = Path("watch.csv"),
    ros: Ros = False,
    ros2: Ros2 = False,
) -> None:
    """Say, once a second, whether an odometry of somebody else's can be believed.

    It compares poses with scans, without ground truth: along a bag, or on a robot. There, it also
    publishes `/diagnostics`, until Ctrl-C. It steers nothing.
    """
    length = 10.0 if sub_trajectory is None else sub_trajectory
    place = None if extrinsic is None else extrinsic.strip("[] ").replace(",", " ").split()
    if ros and ros2:
        raise AdaptuneError("give only one of --ros and --ros2")
    if (bag is None) != (ros or ros2):
        raise AdaptuneError("name a bag, or listen on a robot with --ros or --ros2")
    if bag is not None:
        _along(bag, odometry, points, length, (place, clock_offset, pose_time), out)
        return
    if points is None:
        raise AdaptuneError("--points: name the topic of the scans on the robot")
    _on_robot(odometry, points, length, place, ros2=ros2, out=out)


def _along(
    bag: Path,
    odometry: str,
    points: str | None,
    length: float,
    given: tuple[list[str] | None, float, str],
    out: Path,
) -> None:
    import numpy as np

    from adaptune.evaluation.given import convention, read
    from adaptune.recording.config import NO_REFERENCE
    from adaptune.recording.recording import RecordedSequence
    from adaptune.tuning.asked import usable
    from online.watch import Watch, in_words, write_told

    with progress() as show:
        found = usable(bag, points, NO_REFERENCE, show)
        scans, span = RecordedSequence(found.config()), found.scan.span if found.scan else 0
        trajectory = read(odometry, scans, convention(*given), span)
        seen, told = Watch(length), list["Told"]()
        for i, scan in enumerate(scans, 1):
            (T_odom_sensor,) = trajectory.at(np.array([scan.stamp]))
            told += filter(None, [seen.see(scan, T_odom_sensor)])
            show("watching", i, max(i, scans.n_messages))
    write_told(out, told)
    for sentence in (*in_words(told), f"A row a second: {out}"):
        say(sentence)


def _on_robot(
    odometry: str,
    points: str,
    length: float,
    place: list[str] | None,
    *,
    ros2: bool,
    out: Path,
) -> None:
    from pydantic import ValidationError

    from adaptune.machine import pin
    from adaptune.ros.relay import local_ros1
    from adaptune.ros.ros2 import local_ros2
    from adaptune.study.config import SteerConfig
    from online.watch import in_words, watch_topics, write_told

    try:
        settings = SteerConfig(node=odometry, odometry=odometry, extrinsic=place)
    except ValidationError as error:
        why = error.errors()[0]
        raise AdaptuneError(f"--{why['loc'][0]}: {why['msg']}") from error
    told: list[Told] = []
    link = local_ros2() if ros2 else local_ros1()
    with closing(link), pin(os.getpid(), alone=True), progress() as show:
        log.info("watch, %s: Ctrl-C ends it", odometry)

        def tell(one: "Told") -> None:
            if told and told[-1].state != one.state:
                log.warning("%s is %s at %.1f s: %s", odometry, one.state, one.seconds, one.why)
            told.append(one)
            show("watching", len(told), len(told), f"{one.state}, error {one.error:.2f} %")

        watch_topics(link, points, settings, length, tell)
    write_told(out, told)
    for sentence in (*in_words(told), f"A row a second: {out}"):
        say(sentence)
