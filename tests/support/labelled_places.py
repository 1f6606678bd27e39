"""Labelled sequences for tests, made up from errors or from motions."""

import itertools

import numpy as np
from rooms import along_x
from tables import table

from adaptune.live.hops import Hops
from adaptune.metrics import sub_trajectory_vectors
from offline.labelled import BankSimulation, LabelledData, LabelledSequence, segments

TRIALS = (0, 3, 4, 7, 8)
SETS = table(np.linspace(0.0, 1.0, 5)[:, None], TRIALS)


def labelled(sequences):
    return LabelledData(sequences, SETS)


def sequence(name, means, kind, rng, n=80):
    """A sequence of one kind of place, whose errors differ from set to set."""
    histograms = rng.poisson(3.0, (n, 90)).astype(float)
    histograms[:, kind * 9 : kind * 9 + 9] += 30.0
    errors = (np.array(means) * rng.uniform(0.9, 1.1, (n, 1))).astype(np.float32)
    return of_errors(name, errors, histograms)


def of_errors(name, errors, histograms=None, **more):
    """A sequence of one segment along x with these errors, on which no motions are known."""
    n = len(errors)
    described = np.zeros((n + 34, 90))
    described[:n] = 0.0 if histograms is None else histograms
    simulation = simulated(described, lambda _: None)
    return in_place(name, simulation, np.arange(n + 34) < n, errors, **more)


def simulated(described, motions, T_ref_sensor=None):
    """A drive, ten scans a second, by default along x, 0.3 m from each to the next."""
    n = len(described)
    if T_ref_sensor is None:
        T_ref_sensor = along_x(0.3 * np.arange(n))
    stamps = np.arange(n, dtype=np.int64) * 10**8
    hops = Hops.of([])
    return BankSimulation(
        stamps, T_ref_sensor, T_ref_sensor, described, np.arange(n) // 10, 10.0, 3.0, hops, motions
    )


def in_place(name, simulation, known, errors, **more):
    """A sequence with errors on its known frames."""
    frames = np.flatnonzero(known)
    place = (name, name, simulation, frames, segments(simulation, frames))
    more |= {"block": segments(simulation, frames, 2.0)}
    return LabelledSequence(*place, errors, {"ndt": 90}, **more)


def two_kinds(rng):
    """Set 2 does everywhere; set 1 is better in one kind of place, set 4 in the other."""
    kinds = {0: [1.5, 0.5, 1.0, 2.0, 3.0], 1: [2.0, 3.0, 1.0, 1.5, 0.4]}
    return [sequence(f"{k}{i}", kinds[k], k, rng) for k, i in itertools.product((0, 1), range(4))]


def with_motions(of, rng, n_steps=300):
    """A sequence along x on which sets 0 and 4 err in opposite directions, and set 2 in both."""
    noise = rng.normal(0.0, 0.003, (n_steps - 1, 5))
    noise[:, [0, 4]] = noise[:, :1] * [1.0, -1.0]
    motions = np.tile(np.eye(4), (n_steps - 1, 5, 1, 1))
    motions[..., 0, 3] = 0.3 + noise
    motions[..., 1, 3] = rng.normal(0.0, 0.0005, noise.shape)
    described = rng.poisson(3.0, (n_steps, 90)).astype(np.float32)
    simulation = simulated(described, lambda m: motions[:, SETS.columns(m)])
    vectors = []
    for j in range(5):
        T = np.tile(np.eye(4), (n_steps, 1, 1))
        T[1:, :2, 3] = np.cumsum(motions[:, j, :2, 3], axis=0)
        vectors.append(sub_trajectory_vectors(simulation.T_ref_sensor, T, 10.0))
    errors = np.linalg.norm(vectors, axis=2).T.astype(np.float32)
    known = ~np.isnan(errors[:, 0])
    of_sets = {t: v[known].astype(np.float32) for t, v in zip(TRIALS, vectors, strict=True)}
    return in_place(of, simulation, known, errors[known], vectors=of_sets)
