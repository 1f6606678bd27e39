"""Odometries by name on a drive straight ahead along a street.

Those in containers run the reference image, which is there only when one of them is made.
"""

import copy
import sys
import tempfile
import threading
from functools import cache
from pathlib import Path
from queue import SimpleQueue

import drives
import numpy as np
import program
from needs import reference_image

from adaptune.odometry.base import InProcess
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.odometry.program import Command, ProgramInput
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits, Process
from adaptune.odometry.serving import listen
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
TEMPLATE = """\
use_sim_time: true
gicp: {max_correspondence_distance: 1.0, keyframe_interval: 1.0, downsampling: 0.5, iterations: 20}
"""


def make(name, parameters=None):
    """A new instance; of programs, keyframe GICP that is served and program.py."""
    if name in ("docker_command", "rustle"):
        given = space_of(name).baseline | (parameters or {})
        return copy.deepcopy(_that_has_run(name, tuple(given.items())))
    if name in ("docker_process", LOCKSTEP):
        given = parameters or {}
        return _contained(
            name, given if name == "docker_process" else space_of(name).baseline | given
        )
    if name == "process":
        return Process(parameters or {}, served(), Limits(seconds=60.0))
    if name == "command":
        given = space_of(name).baseline | (parameters or {})
        settings, recording = command_on_the_street()
        Command.check(settings, given)
        return Command(given, settings, Limits(seconds=10.0), lambda: recording)
    return InProcess(odometry_class(name)(parameters))


@cache
def _that_has_run(name, parameters):
    """One that has run on the drive, which takes seconds."""
    odometry = _contained(name, dict(parameters))
    odometry.start(odometry.prepare(scan(0)), np.eye(4))
    return odometry


def _contained(name, parameters):
    """A new instance whose program is in a container."""
    from adaptune.odometry.docker.programs import DockerProcess

    kind = odometry_class("rustle" if name == LOCKSTEP else name)
    image, file = reference_image(), Path(_folder.name) / "params.yaml"
    file.write_text(TEMPLATE)
    given = {
        "docker_command": {"command": ("odometry-plain", "{points}"), "template": str(file)},
        "docker_process": {"command": ("odometry-serve", "{socket}")},
        "rustle": {"template": str(file), "odometry": "/Odometry", "rate": 4.0},
        LOCKSTEP: {"play": "lockstep", "node": "/gicp", "patience": 60.0},
    }
    given[LOCKSTEP] |= {"template": str(file), "odometry": "/Odometry"}
    settings = kind.settings_type(image=image, **given[name])
    if kind is not DockerProcess:
        kind.check(settings, parameters)
    recording = command_on_the_street()[1]
    return kind.instance(parameters, settings, Limits(seconds=60.0), lambda: recording)


def parameters_of(odometry):
    """The present parameters of what `make` has made."""
    return (odometry.odometry if isinstance(odometry, InProcess) else odometry).parameters


def space_of(name):
    if name == "command":
        return ParameterSpace(
            {
                "registration.voxel": Float(low=0.2, high=2.0, baseline=0.5, log=True),
                "registration.distance": Float(low=0.5, high=4.0, baseline=2.0, log=True),
            }
        )
    if name in ("docker_command", "rustle", LOCKSTEP):
        tuned = ("max_correspondence_distance", "keyframe_interval")
        return ParameterSpace({key: KeyframeGicp.space.parameters[key] for key in tuned})
    if name == "docker_process":
        return KeyframeGicp.space
    return Process.describe(served()).space if name == "process" else odometry_class(name).space


def listening(where, name):
    """Serve an odometry in a thread; returns its address."""
    there = SimpleQueue()
    threading.Thread(target=listen, args=(where, name, there.put), daemon=True).start()
    return there.get(timeout=10.0)


def is_live(name):
    if name in ("command", "docker_command", "rustle"):
        return False
    return name in ("process", "docker_process", LOCKSTEP) or odometry_class(name).live


@cache
def served():
    return Process.settings_type(address=listening("tcp://127.0.0.1:0", "gicp"))


@cache
def command_on_the_street():
    """A program's settings, and the drive as a bag for it."""
    folder = Path(_folder.name)
    scans = [(scan(i).stamp, scan(i).points, np.eye(4)) for i in range(N_SCANS)]
    bag = drives.write_bag(folder / "drive.bag", scans)
    (folder / "program.json").write_text('{"registration": {"voxel": 1, "distance": 1}}')
    arguments = (program.__file__, "{input}", "{points}", "{output}", "{parameters}")
    settings = Command.settings_type(
        command=(sys.executable, *arguments), template=str(folder / "program.json")
    )
    stamps = np.array([stamp for stamp, *_ in scans], np.int64)
    return settings, ProgramInput(bag, "/points", "", stamps, None)


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
