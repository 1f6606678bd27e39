"""Objects of several scenes, each with its origin on the ground."""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from adaptune.simulation import mesh as meshes
from adaptune.simulation.mesh import Material, Mesh, blob, box, foliage, grid, merge, mesh, tube
from adaptune.simulation.scenes.base import Floats, Tile

VARIANTS = 4
"""How many different trees, bushes and boulders there are."""


@cache
def tree(variant: int) -> Mesh:
    """Broad-leaved tree of some 8 m, with a trunk free of leaves below 2.2 m."""
    rng = np.random.default_rng([17, variant])
    bend = rng.normal(0.0, 0.12, (4, 2)).cumsum(axis=0)
    heights = np.array([-0.3, 0.6, 2.2, 4.0, 6.5])
    radii = np.array([0.26, 0.19, 0.16, 0.12, 0.02])
    spine = np.concatenate([np.zeros((1, 2)), bend])
    parts = [tube(np.column_stack([spine, heights, radii]), Material.BARK, 8)]
    tips = []
    for angle in rng.uniform(0.0, 2.0 * np.pi, 6):
        foot = np.array([*spine[2], rng.uniform(2.2, 3.6)])
        tip = foot + rng.uniform(1.2, 2.2) * np.array([np.cos(angle), np.sin(angle), 0.7])
        parts.append(tube([[*foot, 0.07], [*tip, 0.02]], Material.BARK, 5))
        tips.append(tip)
    clumps = np.array([*tips, [*spine[4], 5.8], [*spine[3], 4.6]])
    centres = clumps[rng.integers(len(clumps), size=280)]
    parts.append(foliage(centres, (1.2, 1.2, 0.9), 0.28, variant))
    return merge(parts)


@cache
def bush(variant: int) -> Mesh:
    """Bush of a metre's height: leaves about a denser heart."""
    heart = blob(Material.LEAVES, 100 + variant, 0.4, 7)
    centres = np.tile([[0.0, 0.0, 0.45]], (70, 1))
    return merge([meshes.place(heart, (0, 0, 0), 0.0, 0.45), foliage(centres, 0.6, 0.2, variant)])


@cache
def boulder(variant: int) -> Mesh:
    """Boulder of a metre's radius."""
    return blob(Material.ROCK, variant, 0.5, 10)


def _extrude(profile: ArrayLike, width: float, material: Material) -> Mesh:
    """Make a body with a convex profile in x and z, `width` metres wide along y."""
    outline = np.asarray(profile, np.float64)
    n = len(outline)
    x, z = outline.T
    sides = [np.column_stack([x, np.full(n, y), z]) for y in (-width / 2.0, width / 2.0)]
    closed = np.stack([np.vstack([side, side[:1]]) for side in sides])
    fan = np.array([[0, i, i + 1] for i in range(1, n - 1)])
    return merge([grid(closed, material), *(mesh(side, fan, material) for side in sides)])


@cache
def car() -> Mesh:
    """Car of 4.3 m, heading along x."""
    rear, front = [(-2.0, 0.92), (-2.15, 0.7)], [(2.15, 0.62), (1.95, 0.75), (1.0, 0.86)]
    body = _extrude([(-2.1, 0.3), (2.15, 0.3), *front, *rear], 1.76, Material.METAL)
    windows = [(-1.9, 0.9), (1.0, 0.85), (0.3, 1.42), (-0.3, 1.48), (-1.3, 1.42)]
    cabin = _extrude(windows, 1.5, Material.GLASS)
    roof = box((1.5, 1.5, 0.04), Material.METAL, (-0.5, 0.0, 1.45))
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    rim = np.column_stack([0.31 * np.cos(turn), 0.31 + 0.31 * np.sin(turn)])
    wheels = [[x, y, 0.0] for x in (-1.3, 1.35) for y in (-0.78, 0.78)]
    return merge([body, cabin, roof, meshes.place(_extrude(rim, 0.2, Material.METAL), wheels)])


@cache
def walker() -> Mesh:
    """Person of 1.75 m in mid-step."""
    torso = [[0.0, 0.0, 0.85, 0.16], [0.0, 0.0, 1.1, 0.17]]
    limbs = [
        [[-0.25, 0.1, 0.0, 0.06], [-0.05, 0.1, 0.5, 0.07], [0.0, 0.08, 0.9, 0.1]],
        [[0.3, -0.1, 0.0, 0.06], [0.15, -0.1, 0.5, 0.07], [0.0, -0.08, 0.9, 0.1]],
        [*torso, [0.02, 0.0, 1.42, 0.19], [0.02, 0.0, 1.5, 0.06]],
        [[0.03, 0.0, 1.48, 0.06], [0.04, 0.0, 1.62, 0.1], [0.04, 0.0, 1.75, 0.03]],
        [[0.2, 0.26, 0.85, 0.04], [0.02, 0.24, 1.4, 0.05]],
        [[-0.2, -0.26, 0.85, 0.04], [0.02, -0.24, 1.4, 0.05]],
    ]
    return merge([tube(limb, Material.CLOTH, 8) for limb in limbs])


@cache
def lamp() -> Mesh:
    """Street lamp of 6 m whose arm reaches out along y."""
    pole = tube([[0, 0, -0.2, 0.11], [0, 0, 1.0, 0.09], [0, 0, 6.0, 0.06]], Material.METAL, 8)
    arm = box((0.08, 1.4, 0.06), Material.METAL, (0.0, 0.7, 5.9))
    return merge([pole, arm, box((0.2, 0.6, 0.1), Material.METAL, (0.0, 1.3, 5.85))])


@cache
def sign() -> Mesh:
    """Road sign at 2.2 m, facing along x."""
    pole = tube([[0, 0, -0.2, 0.04], [0, 0, 2.7, 0.04]], Material.METAL, 6)
    return merge([pole, box((0.03, 0.6, 0.6), Material.METAL, (0.05, 0.0, 2.1))])


@cache
def bench() -> Mesh:
    """Bench of 1.8 m along x, facing -y."""
    seat = box((1.8, 0.45, 0.06), Material.WOOD, (0.0, 0.0, 0.42))
    back = box((1.8, 0.06, 0.4), Material.WOOD, (0.0, 0.22, 0.5))
    feet = [box((0.1, 0.45, 0.45), Material.METAL, (x, 0.0, 0.0)) for x in (-0.75, 0.75)]
    return merge([seat, back, *feet])


def strew(
    tile: Tile, models: list[Mesh], s: Floats, d: Floats, scale: ArrayLike, *, sink: float = 0.1
) -> Mesh:
    """Put models, in turn and turned at random, at stations and offsets, sunk into the ground."""
    scale = np.broadcast_to(np.asarray(scale, np.float64), len(s))
    yaw = tile.rng.uniform(0.0, 2.0 * np.pi, len(s))
    at = tile.at(s, d, -sink * scale)
    n, used = len(models), models[: len(s)]
    placed = [meshes.place(m, at[i::n], yaw[i::n], scale[i::n]) for i, m in enumerate(used)]
    return merge(placed)


def wall(tile: Tile, s: ArrayLike, d: ArrayLike, height: ArrayLike, material: Material) -> Mesh:
    """Raise a wall of some height over a line of stations and offsets, from below the ground."""
    foot = tile.at(s, d, -0.3)
    top = foot.copy()
    top[:, 2] += 0.3 + np.asarray(height)
    return grid(np.stack([foot, top]), material)
