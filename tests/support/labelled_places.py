"""Labelled sequences for tests, made up from errors or from motions."""

import itertools
from dataclasses import replace

import numpy as np
from tables import table

from adaptune.live.hops import Hops
from adaptune.metrics import sub_trajectory_vectors
from offline.labelled import BankSimulation, Extent, LabelledData, LabelledSequence, cut

TRIALS = (0, 3, 4, 7, 8)
SETS = table(np.linspace(0.0, 1.0, 5)[:, None], TRIALS)


def labelled(sequences):
    return LabelledData(sequences, SETS)


def sequence(name, means, kind, rng, n=80):
    """A sequence of one kind of place, whose errors differ from set to set."""
    histograms = rng.poisson(3.0, (n, 90)).astype(float)
    histograms[:, kind * 9 : kind * 9 + 9] += 30.0
    errors = (np.array(means) * rng.uniform(0.9, 1.1, (n, 1))).astype(np.float32)
    return LabelledSequence(name, np.arange(n) // 10, histograms, errors)


def two_kinds(rng):
    """Set 2 does everywhere; set 0 is better in one kind of place, set 4 in the other."""
    kinds = {0: [0.5, 1.5, 1.0, 2.0, 3.0], 1: [3.0, 2.0, 1.0, 1.5, 0.4]}
    return [sequence(f"{k}{i}", kinds[k], k, rng) for k, i in itertools.product((0, 1), range(4))]


def with_motions(of, rng, n_steps=300):
    """A sequence along x on which sets 0 and 4 err in opposite directions, and set 2 in both."""
    T_ref_sensor = np.tile(np.eye(4), (n_steps, 1, 1))
    T_ref_sensor[1:, 0, 3] = 0.3 * np.arange(1, n_steps)
    stamps = np.arange(n_steps, dtype=np.int64) * 10**8
    noise = rng.normal(0.0, 0.003, (n_steps - 1, 5))
    noise[:, [0, 4]] = noise[:, :1] * [1.0, -1.0]
    motions = np.tile(np.eye(4), (n_steps - 1, 5, 1, 1))
    motions[..., 0, 3] = 0.3 + noise
    motions[..., 1, 3] = rng.normal(0.0, 0.0005, noise.shape)
    vectors, errors = [], []
    for j in range(5):
        T = np.tile(np.eye(4), (n_steps, 1, 1))
        T[1:, :2, 3] = np.cumsum(motions[:, j, :2, 3], axis=0)
        vectors.append(sub_trajectory_vectors(T_ref_sensor, T, 10.0))
        errors.append(np.linalg.norm(vectors[-1], axis=1))
    known = ~np.isnan(errors[0])
    described = rng.poisson(3.0, (n_steps, 90)).astype(np.float32)
    period = np.arange(n_steps) // 10
    simulation = BankSimulation(
        stamps,
        T_ref_sensor,
        described,
        period,
        10.0,
        3.0,
        Hops.of([]),
        lambda m: motions[:, SETS.columns(m)],
    )
    return LabelledSequence(
        of,
        period[known],
        described[known],
        np.array(errors, np.float32).T[known],
        vectors={t: v[known].astype(np.float32) for t, v in zip(TRIALS, vectors, strict=True)},
        simulation=simulation,
    )


def in_stretches(sequence):
    """The same sequence with its extent, cut into stretches."""
    simulation = sequence.simulation
    T_ref_sensor, length = simulation.T_ref_sensor, simulation.length
    known = np.arange(len(T_ref_sensor)) < len(sequence.errors)
    extent = Extent.of(T_ref_sensor, known, length)
    return replace(sequence, extent=extent, cuts=cut(T_ref_sensor, extent))
