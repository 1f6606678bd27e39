"""Estimated references that are made up, without an estimation."""

import secrets

import numpy as np
from rooms import along_x

from adaptune.reference.estimated import EstimatedReference, Registrations
from adaptune.study import references

STEP = 0.3


class Estimator:
    """Makes references of `drives` that are too long, and halves that differ from each other."""

    def __init__(self, untrusted=()):
        self.factor, self.untrusted = 1.001, list(untrusted)
        self.asked = []  # the name of every recording
        self.refusal = None

    def __call__(self, scans, advance=lambda *_: None):
        self.asked.append(scans.name)
        if self.refusal is not None:
            raise self.refusal
        stamps = np.array([scan.stamp for scan in scans], np.int64)
        advance(len(stamps), scans.n_messages)
        trusted = np.ones(len(stamps) - 1, bool)
        trusted[self.untrusted] = False
        return EstimatedReference(
            stamps,
            self._poses(stamps, self.factor),
            trusted,
            np.stack([self._poses(stamps, factor) for factor in (1.003, 0.999)]),
            Registrations(np.array([0]), np.array([7]), np.array([True]), np.array([0.01])),
        )

    @property
    def names(self):
        return [name.rpartition("/")[2] for name in self.asked]

    @staticmethod
    def _poses(stamps, factor):
        return along_x(factor * STEP * (stamps - stamps[0]) * 1e-8)


def install(monkeypatch, untrusted=()):
    """Let all references be estimated in this way, whatever was estimated before."""
    monkeypatch.setattr(references, "ESTIMATES", f"references-{secrets.token_hex(4)}")
    monkeypatch.setattr(references, "_wholes", {})
    estimator = Estimator(untrusted)
    monkeypatch.setattr("adaptune.reference.estimate.estimate_reference", estimator)
    return estimator


def smooth(T, seed):
    """Poses with an error that grows and wanes slowly, of about 0.02 m."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 2.0 * np.pi, len(T))[:, None] * rng.uniform(1.0, 3.0, 3)
    wrong = T.copy()
    wrong[:, :3, 3] += 0.02 * np.sin(phase + rng.uniform(0.0, np.pi, 3))
    return wrong


def made_of(stamps, T, lost=()):
    """An estimated reference of the true poses of all scans; after those in `lost` it is lost."""
    trusted = np.ones(len(T) - 1, bool)
    trusted[list(lost)] = False
    made, *halves = (smooth(T, seed) for seed in range(3))
    none = np.zeros(0, np.intp)
    found = Registrations(none, none, none.astype(bool), none.astype(float))
    return EstimatedReference(stamps, made, trusted, np.stack(halves), found)
