"""A reference of the drives in `drives`, as if it were estimated, and what it was asked for."""

import numpy as np
from rooms import along_x

from adaptune.reference.stored import EstimatedReference, Registrations

STEP = 0.3


class Estimator:
    """Makes estimates that are too long by a factor, and halves that differ from each other."""

    def __init__(self, factor=1.001, halves=(1.003, 0.999), untrusted=()):
        self.factor, self.halves, self.untrusted = factor, halves, list(untrusted)
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
            np.stack([self._poses(stamps, half) for half in self.halves]),
            Registrations(np.array([0]), np.array([7]), np.array([True]), np.array([0.01])),
        )

    @property
    def names(self):
        return [name.rpartition("/")[2] for name in self.asked]

    @staticmethod
    def _poses(stamps, factor):
        return along_x(factor * STEP * (stamps - stamps[0]) * 1e-8)


def install(monkeypatch, *given, **settings):
    """Let all references be estimated in this way."""
    estimator = Estimator(*given, **settings)
    monkeypatch.setattr("adaptune.reference.estimate.estimate_reference", estimator)
    return estimator
