"""What tests of odometries in containers share: a short drive, settings, and a look at the engine.

Nothing here starts a container when it is imported.
"""

import json
import os
from functools import cache

import drives
import numpy as np
import street
from needs import reference_image
from rooms import along_x

from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.remote import Limits
from adaptune.odometry.systems.engine import engine
from adaptune.odometry.systems.rustle import RustleSettings
from adaptune.recording import Scan

LABEL = "adaptune.owner"
N_SCANS = 40
LIMITS = Limits(seconds=60.0, memory=2.0)
VALUES = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.5}
"""Of the parameters in the template that are tuned here."""
FIXED = {"downsampling": 0.7, "iterations": 20}
"""The others, as they stand in the template."""
TEMPLATE = """\
use_sim_time: true
common: {{points_topic: {points}}}
gicp: {{max_correspondence_distance: 9.0, keyframe_interval: 9, downsampling: 0.7, iterations: 20}}
other: {{voxel: 1}}
imitate: {imitate}
"""


@cache
def scans():
    """Scans of a drive of four seconds, 0.3 m apart."""
    return [Scan(stamp, points) for stamp, points, _ in drives.scans(n_scans=N_SCANS)]


def truth():
    return along_x(0.3 * np.arange(N_SCANS))


def recording(folder, logs=None):
    """The drive as a bag, for odometries that run whole recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    bag = drives.write_bag(folder / "drive.bag", drives.scans(n_scans=N_SCANS))
    stamps = np.array([scan.stamp for scan in scans()], np.int64)
    return ProgramInput(bag, "/points", "", stamps, truth(), logs)


def template(path, points="/points", **imitate):
    path.write_text(TEMPLATE.format(points=points, imitate=json.dumps(imitate)))
    return path


def rustle(file, **settings):
    given = {"image": reference_image(), "odometry": "/Odometry", "rate": 4.0}
    return RustleSettings(template=str(file), **(given | settings))


def drive(odometry, first=0, T=None):
    return street.drive(odometry, [odometry.prepare(scan) for scan in scans()[first:]], T)


@cache
def host_poses(**parameters):
    """What keyframe GICP finds in this process; parameters left out are the template's."""
    return drive(InProcess(KeyframeGicp(VALUES | FIXED | parameters)))


def containers(pid=None):
    """Containers that a process, by default this one, has started and not removed."""
    labelled = engine().api.containers(all=True, filters={"label": LABEL})
    pid = f".{pid or os.getpid()}."
    return [found["Id"] for found in labelled if pid in found["Labels"][LABEL]]
