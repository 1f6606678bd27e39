"""A study of a ROS system, to fill in: what is known of it by its image or its command."""

import re
import shlex
from pathlib import Path
from typing import Any

from adaptune.errors import AdaptuneError, NotInstalledError
from adaptune.files import plain_name, write_text
from adaptune.progress import Progress
from adaptune.tuning.asked import Asked, recorded
from adaptune.tuning.studies import ROLES, USUAL_LENGTH, roles
from adaptune.yaml12 import YamlPath, dump

LACKING = "FILL_IN"
"""Stands where the user knows more."""


def system_of(given: str) -> dict[str, Any] | None:
    """The image or the launch command of a ROS system, as settings; None if it is none."""
    words = shlex.split(given)
    if words[:1] == ["ros2"]:
        if not any("{parameters}" in word for word in words):
            words.append(f"{LACKING}:={{parameters}}")
        return {"command": words}
    if not is_image(given):
        return None
    launch = ["ros2", "launch", LACKING, f"{LACKING}.launch.py", f"{LACKING}:={{parameters}}"]
    return {"image": given, "command": launch}


def is_image(given: str) -> bool:
    """Whether a name is that of an image, and of no odometry."""
    from adaptune.odometry import registry
    from adaptune.odometry.docker.engine import EngineError, image_digest

    of_odometry = given in {*registry.ODOMETRIES, *registry.PROGRAMS, "all"}
    if of_odometry or not re.fullmatch(r"[a-z0-9][\w./-]*(:[\w.-]+)?", given):
        return False
    try:
        image_digest(given)
    except (EngineError, NotInstalledError):
        if "/" in given:  # no name of an odometry
            raise
        return False
    return True


def proposed_system(asked: Asked, show: Progress) -> Path | None:
    """Write a study of a ROS system to fill in; None if the odometry is none."""
    if (settings := system_of(asked.odometry)) is None:
        return None
    path = Path(f"{plain_name(asked.recordings[0].resolve())}_ros2.yaml")
    if path.exists():
        raise AdaptuneError(f"{path}: exists; fill it in, or move it away")
    named, test = recorded(asked, show)
    settings |= {
        "template": str(asked.config.resolve()) if asked.config else LACKING,
        "odometry": f"/{LACKING}",
        "points": "/points",
    }
    below: YamlPath = ("odometry", "settings")
    comments: dict[YamlPath, str] = ROLES | {
        ("odometry", "name"): "Or rustle, for a ROS 1 system, see docs/docker.md.",
        (*below, "template"): "The parameter file that you use now.",
        (*below, "odometry"): "The topic of its poses.",
        (*below, "points"): "The topics that it hears, as imu: /imu",
        ("odometry", "parameters"): "What to tune.",
    }
    if all("imu" in one.given for one in named.values()):
        settings["imu"] = "/imu"
    guess = {"type": "float", "low": 0.1, "high": 2.0, "baseline": 0.5}
    odometry = {"name": "ros2", "settings": settings, "parameters": {LACKING: guess}}
    sequences = {name: one.given for name, one in named.items()}
    training = [name for name in named if name not in test]
    data = {"sequences": sequences} | roles(training, USUAL_LENGTH, odometry, test=test)
    write_text(path, dump(data, comments))
    return path
