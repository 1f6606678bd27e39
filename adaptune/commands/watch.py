"""The command that watches an odometry of somebody else's."""

import logging
import math
import os
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adaptune.commands.evaluate import Place
from adaptune.commands.terminal import Points, progress, say
from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from adaptune._system.progress import Progress
    from adaptune.evaluation.given import Convention
    from online.watch import Told

log = logging.getLogger(__name__)

Bag = Annotated[Path | None, typer.Argument(help="A recording; none on a robot.")]
Poses = Annotated[
    str, typer.Option(metavar="POSES", help="A topic, a chain of transforms, or a file of poses.")
]
Length = Annotated[float, typer.Option(metavar="METRES", help="What errors are told over.")]
Table = Annotated[Path, typer.Option(help="The table, CSV: a row a second.", dir_okay=False)]
Ros = Annotated[bool, typer.Option("--ros", help="Listen on a robot with ROS 1.")]
Ros2 = Annotated[bool, typer.Option("--ros2", help="Listen on a robot with ROS 2.")]


def watch(
    odometry: Poses,
    bag: Bag = None,
    points: Points = None,
    extrinsic: Place = None,
    sub_trajectory: Length = 25.0,
    out: Table = Path("watch.csv"),
    ros: Ros = False,
    ros2: Ros2 = False,
) -> None:
    """Say, once a second, whether an odometry of somebody else's can be believed.

    It compares poses with scans, without ground truth: along a bag, or on a robot. There, it also
    publishes `/diagnostics`, until Ctrl-C. It steers nothing.
    """
    from adaptune.evaluation.given import convention
    from online.watch import in_words, write_told

    by, told = convention(extrinsic, 0.0, "stamp"), list["Told"]()
    if [bag is not None, ros, ros2].count(True) != 1:
        raise AdaptuneError("name a bag, or listen on a robot with --ros or --ros2")
    if not 0.0 < sub_trajectory < math.inf:
        raise AdaptuneError("--sub-trajectory: give metres, more than 0")
    if bag is None and points is None:
        raise AdaptuneError("--points: name the topic of the scans on the robot")
    try:
        with progress() as show, suppress(KeyboardInterrupt):
            if bag is not None:
                every = _along(bag, odometry, points, sub_trajectory, by, show)
            else:
                every = _on_robot(odometry, points or "", sub_trajectory, by, show, ros2=ros2)
            for one in every:
                if told and told[-1].state != one.state:
                    what = f"{odometry} is {one.state} at {one.seconds:.1f} s"
                    log.warning("%s%s", what, f": {one.why}" if one.why else "")
                told.append(one)
    finally:  # what was told is kept, whatever ends it
        if told:
            write_told(out, told)
    for sentence in (*in_words(told), f"A row a second: {out}"):
        say(sentence)


def _along(
    bag: Path, odometry: str, points: str | None, length: float, by: "Convention", show: "Progress"
) -> Iterator["Told"]:
    import numpy as np

    from adaptune.evaluation.given import read
    from adaptune.recording.config import NO_REFERENCE
    from adaptune.recording.recording import RecordedSequence
    from adaptune.tuning.asked import usable
    from online.watch import Watch

    scans = RecordedSequence(usable(bag, points, NO_REFERENCE, show).config())
    trajectory, watched = read(odometry, odometry, scans, by, 0), Watch(length)
    for i, scan in enumerate(scans, 1):
        if told := watched.see(scan, trajectory.at(np.array([scan.stamp]))[0]):
            yield told
        show("watching", i, max(i, scans.n_messages))


def _on_robot(
    odometry: str, points: str, length: float, by: "Convention", show: "Progress", *, ros2: bool
) -> Iterator["Told"]:
    from pydantic import TypeAdapter, ValidationError

    from adaptune._system.machine import pin
    from adaptune._system.strict import in_one_line
    from adaptune.ros.relay import local_ros1
    from adaptune.ros.ros2 import local_ros2
    from adaptune.study.config import RosName
    from online.watch import watch_topics

    try:
        TypeAdapter(RosName).validate_python(odometry)
    except ValidationError as error:
        raise AdaptuneError(f"--odometry {odometry}: {in_one_line(error)}") from error
    with closing(local_ros2() if ros2 else local_ros1()) as link, pin(os.getpid(), alone=True):
        log.info("watch, %s: Ctrl-C ends it", odometry)
        for n, told in enumerate(watch_topics(link, points, odometry, by.T_body_sensor, length), 1):
            known = f", error {told.error:.2f} %" if math.isfinite(told.error) else ""
            show("watching", n, n, told.state + known)
            yield told
