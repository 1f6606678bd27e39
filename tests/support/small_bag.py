"""Small ROS 1 bags with clouds and poses, and what tests look for when they are inspected."""

import os

import numpy as np
import rec
from pydantic import TypeAdapter
from rich.console import Console

from adaptune._system import yaml12
from adaptune.recording import SequenceConfig
from adaptune.recording.rendering import render_inspection

START = 1_700_000_000_000_000_000


def cloud(stamp, n=200):
    raw = np.zeros(n, [(name, "<f4") for name in ("x", "y", "z", "time")])
    raw["x"], raw["y"], raw["z"] = np.random.default_rng(stamp).normal(0, 10, (n, 3)).T
    raw["time"][5:] = np.linspace(0, 0.1, n - 5)
    raw[:5] = np.nan
    return rec.cloud(raw, stamp, rec.ROS1)


def bad_cloud(stamp, of):
    """A cloud that is cut, or has no or few valid points."""
    made = cloud(stamp)
    if of == "cut":
        made.data = made.data[:-1]
        return made
    values = {"NaN": np.nan, "zero": 0.0, "far": 2000.0, "few": 0.0}
    raw = made.data.view("<f4").reshape(-1, 4)
    raw[19 if of == "few" else 0 :, :3] = values[of]
    if of == "few":
        raw[:19, :3] = 1.0
    return made


def pose(stamp, x):
    return rec.pose(stamp, (x, 0, 0), (0, 0, 0, 1), rec.ROS1)


def replace_bag(path, offset=0):
    """Put another bag of the same time in its place, of the same size if there is no offset."""
    times = path.stat().st_atime_ns, path.stat().st_mtime_ns
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data + bytes(offset))
    os.utime(path, ns=times)


def drive(path, stamps, poses):
    messages = [
        ("/points", START + i * 10**8, cloud(START + round(s * 1e9))) for i, s in enumerate(stamps)
    ]
    messages += [("/poses", START, pose(START + round(s * 1e9), x)) for s, x in poses]
    return rec.write_bag(path, messages)


def inspection_text(inspection, width=100):
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(render_inspection(inspection))
    return capture.get()


def entry(inspection):
    """The proposed entry, read back as a study would."""
    data = yaml12.Document(inspection.entry).data["sequences"]
    return TypeAdapter(dict[str, SequenceConfig]).validate_python(data)


def texts(inspection):
    return [str(finding) for finding in inspection.findings]
