"""Estimated references that are made of the ground truth, without an estimation."""

import numpy as np

from adaptune.reference.stored import EstimatedReference, Registrations


def smooth(T, scale, seed=0):
    """Poses with an error that grows and wanes slowly, of about `scale` metres."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 2.0 * np.pi, len(T))[:, None] * rng.uniform(1.0, 3.0, 3)
    wrong = T.copy()
    wrong[:, :3, 3] += scale * np.sin(phase + rng.uniform(0.0, np.pi, 3))
    return wrong


def made_of(stamps, T, scale=0.02, lost=(), seed=0):
    """An estimated reference of the poses of all scans; after the scans in `lost` it is lost."""
    trusted = np.ones(len(T) - 1, bool)
    trusted[list(lost)] = False
    halves = np.stack([smooth(T, scale, seed + 1), smooth(T, scale, seed + 2)])
    none = np.zeros(0, np.intp)
    found = Registrations(none, none, none.astype(bool), none.astype(float))
    return EstimatedReference(stamps, smooth(T, scale, seed), trusted, halves, found)
