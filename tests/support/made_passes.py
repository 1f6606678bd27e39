"""A short simulated course, and passes over recordings that were never driven."""

from functools import cache

import numpy as np
from rooms import moved

from adaptune.geometry import invert, rectify, steps
from adaptune.live.hops import Hop
from adaptune.reference.graph import Consensus, Guess, Pass, pass_over
from adaptune.simulation import Course
from adaptune.simulation.record import simulate

STEP = 0.4
"""Metres between the scans of a made-up pass."""
REACHES = (6, 12, 24)
"""Scans over which it is registered: 2.4, 4.8 and 9.6 m."""


@cache
def course():
    return list(simulate(Course(scenes=("street",), length=25.0, seed=3, columns=160)))


@cache
def passed():
    return pass_over(course())


def truth():
    """Their true poses; the first is the identity."""
    T = np.array([scan.T_world_sensor for scan in course()])
    return invert(T[0]) @ T


def chained(motions):
    """Poses from the identity on."""
    poses = [np.eye(4)]
    for T in motions:
        poses.append(rectify(poses[-1] @ T))
    return np.array(poses)


def winding(n, step=STEP):
    """A path of n poses that winds and climbs."""
    return chained(
        [moved(x=step, z=0.02 * step, yaw=0.03 * np.cos(0.05 * i)) for i in range(n - 1)]
    )


def straight(n, step=STEP):
    return chained([moved(x=step)] * (n - 1))


def drifting(T, share=0.02, yaw=0.001):
    """The same path, when each motion is too long by a share and turns too much."""
    motions = steps(T)
    motions[:, :3, 3] *= 1.0 + share
    return chained(motions @ moved(yaw=yaw))


def hop(T, start, end, off=(0.0, 0.0, 0.0), unknown=()):
    """A registration that is wrong by `off`, and tells nothing along the axes in `unknown`."""
    T_start_end = invert(T[start]) @ T[end]
    T_start_end[:3, 3] += off
    projection = np.eye(3)
    projection[list(unknown), list(unknown)] = 0.0
    return Hop(T_start_end, projection)


def pairs(n, reaches=REACHES, every=3):
    """Scans that are registered to each other."""
    return [(end - reach, end) for end in range(0, n, every) for reach in reaches if end >= reach]


def guesses(T, of=None, member=-1):
    return [Guess(start, end, member, hop(T, start, end)) for start, end in of or pairs(len(T))]


def failed(found, which):
    """The same guesses, where those fail whose start and end `which` says so of."""
    return [g._replace(hop=None) if which(g.start, g.end) else g for g in found]


def made_pass(T, found, members=None, seconds=0.1):
    """A pass whose consensus is at T; its members move as it does unless they are given."""
    stamps = np.arange(len(T), dtype=np.int64) * round(seconds * 1e9)
    motions = np.concatenate([np.eye(4)[None], steps(T)])
    if members is None:
        members = np.repeat(motions[:, None], Consensus.n_members, axis=1)
    return Pass(
        stamps,
        T,
        members,
        sorted(found, key=lambda g: (g.end, g.start, g.member)),
    )
