"""Odometries by name on a drive straight ahead along a street.

Those in containers run the reference image, which is there only when one of them is made.
"""

import copy
import sys
import tempfile
from functools import cache
from pathlib import Path

import drives
import numpy as np
import program
from needs import reference_image
from ros2_reference import ros2

from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.program import ProgramInput
from adaptune.odometry.registry import ODOMETRIES, odometry_class
from adaptune.odometry.remote import Limits, Process
from adaptune.recording import Scan
from adaptune.space import Float, ParameterSpace

STEP = 0.4
N_SCANS = 16
START = 10**10
"""Nanoseconds; ROS has no stamp of zero."""
POOR = {"NaN": np.nan, "near": 0.005, "far": 1e4}
"""Factors of scans that hold nothing to register."""
LOCKSTEP = "rustle, lockstep"
"""The other way to run `rustle`."""
SERVES = """
import sys
sys.path[:] = {path}
from adaptune._system import processes
from adaptune.odometry.registry import converse
processes.answer_all(sys.stdin.buffer, sys.stdout.buffer, converse("gicp"))
"""
TEMPLATE = """\
use_sim_time: true
gicp: {max_correspondence_distance: 1.0, keyframe_interval: 1.0, downsampling: 0.5, iterations: 20}
"""


FILED = ("command", "docker_command", "rustle", LOCKSTEP, "ros2")
"""Programs that read all parameters in a file."""


def make(name, parameters=None):
    """A new instance; of programs, keyframe GICP that is served and program.py."""
    given = parameters or {}
    if name in ODOMETRIES:
        return InProcess(odometry_class(name)(given))
    if name in FILED:
        given = space_of(name).baseline | given
    if name in ("docker_command", "rustle"):
        return copy.deepcopy(_that_has_run(name, tuple(given.items())))
    return _program(name, given)


@cache
def _that_has_run(name, parameters):
    """One that has run on the drive, which takes seconds."""
    odometry = _program(name, dict(parameters))
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    return odometry


def _program(name, parameters):
    kind, settings = _kind(name), _settings(name)
    if name in FILED:
        kind.check(settings, parameters)
    return kind.instance(parameters, settings, Limits(seconds=60.0), recording)


def _kind(name):
    return odometry_class("rustle" if name == LOCKSTEP else name)


@cache
def _settings(name):
    template, file = Path(_folder.name) / "params.yaml", Path(_folder.name) / "program.json"
    template.write_text(TEMPLATE)
    file.write_text('{"registration": {"voxel": 1, "distance": 1}, "speed": 4.0}')
    arguments = (program.__file__, "{input}", "{points}", "{output}", "{parameters}")
    given = {
        "command": {"command": (sys.executable, *arguments), "template": str(file)},
        "docker_command": {"command": ("odometry-plain", "{points}"), "template": str(template)},
        "docker_process": {"command": ("odometry-serve", "{socket}")},
        "rustle": {"template": str(template), "odometry": "/Odometry", "rate": 4.0},
    }
    given[LOCKSTEP] = given["rustle"] | {"play": "lockstep", "node": "/gicp", "patience": 60.0}
    if name == "process":
        return served()
    if name == "ros2":
        return ros2(Path(_folder.name) / "icp.yaml", node="/icp", patience=60.0)
    own = {} if name == "command" else {"image": reference_image()}
    return _kind(name).settings_type(**given[name], **own)


def served():
    """Keyframe GICP that is served by a program."""
    return Process.settings_type(command=(sys.executable, "-c", SERVES.format(path=sys.path)))


def space_of(name):
    if name == "command":
        return ParameterSpace(
            {
                "registration.voxel": Float(low=0.2, high=2.0, baseline=0.5, log=True),
                "registration.distance": Float(low=0.5, high=4.0, baseline=2.0, log=True),
            }
        )
    if name == "ros2":
        return ParameterSpace({"voxel_size": Float(low=0.3, high=1.5, baseline=0.5)})
    if name in FILED:
        tuned = ("max_correspondence_distance", "keyframe_interval")
        return ParameterSpace({key: KeyframeGicp.space.parameters[key] for key in tuned})
    return odometry_class(name if name in ODOMETRIES else "gicp").space


def is_live(name):
    return name not in FILED[:3] and (name not in ODOMETRIES or odometry_class(name).live)


@cache
def recording():
    """The drive as a bag, for programs."""
    scans = [(scan(i).stamp, scan(i).points, np.eye(4)) for i in range(N_SCANS)]
    bag = drives.write_bag(Path(_folder.name) / "drive.bag", scans)
    return ProgramInput(bag, "/points", "", np.array([stamp for stamp, *_ in scans]), None)


_folder = tempfile.TemporaryDirectory()


@cache
def street():
    """Points of a ground, two walls and poles along x, of shape (n, 3)."""
    rng = np.random.default_rng(1)
    u = rng.uniform(-1, 1, (9000, 2))
    ground = np.c_[45 * u[:3000, 0], 9 * u[:3000, 1], np.full(3000, -1.7)]
    walls = np.c_[45 * u[3000:, 0], 9 * rng.choice([-1, 1], 6000), 2 + 4 * u[3000:, 1]]
    at = rng.uniform((-35, -8), (45, 8), (16, 2))[rng.integers(0, 16, 3500)]
    around = rng.uniform(0, 2 * np.pi, 3500)
    poles = np.c_[
        at[:, 0] + 0.3 * np.cos(around), at[:, 1] + 0.3 * np.sin(around), rng.uniform(-1.7, 3, 3500)
    ]
    return np.concatenate([ground, walls, poles])


@cache
def scan(i):
    rng = np.random.default_rng(i)
    points = street()[rng.random(len(street())) < 0.5] - [STEP * i, 0.0, 0.0]
    points += rng.normal(0, 0.01, points.shape)
    return Scan(START + i * 10**8, points.astype(np.float32))


def poor_scan(n, i=0):
    """A scan of `n` points all over the place, in the place of scan `i`.

    Or scan `i` itself with points that are all NaN, too near or too far.
    """
    if n in POOR:
        return Scan(START + i * 10**8, scan(i).points * np.float32(POOR[n]))
    points = np.random.default_rng(n).uniform(2.0, 9.0, (n, 3))
    return Scan(START + i * 10**8, points.astype(np.float32))


@cache
def prepared_drive(name):
    odometry = make(name)
    return [odometry.prepare(scan(i)) for i in range(N_SCANS)]


def drive(odometry, prepared, T_odom_sensor=None):
    T = np.eye(4) if T_odom_sensor is None else T_odom_sensor
    odometry.start(prepared[0], T)
    return np.array([T, *(odometry.register(p).T_odom_sensor for p in prepared[1:])])


@cache
def usual_drive(name):
    return drive(make(name), prepared_drive(name))
