import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adaptune.archive import Archive, Frames, Trial
from adaptune.model.weights import minimum_variance_weights
from offline.portfolio import Portfolio, loss

N, LENGTH = 120, 5.0


def frames():
    T_ref_sensor = np.tile(np.eye(4), (N, 1, 1))
    T_ref_sensor[:, 0, 3] = 0.5 * np.arange(N)
    stamps = np.arange(N, dtype=np.int64) * 10**8
    return Frames(stamps, T_ref_sensor, np.zeros((N, 1), np.float32), {"x": 1}, np.zeros(N))


def trial(number, drift):
    """Errs by so many metres a scan to the left."""
    T = frames().T_ref_sensor.copy()
    T[:, 1, 3] = drift * np.arange(N)
    errors = np.full(N, 100.0 * abs(drift) * 10 / LENGTH)
    errors[-11:] = np.nan
    none = np.zeros(N, bool)
    return Trial({"x": float(number)}, T, errors, none, ~none, np.zeros(N))


@pytest.fixture
def archive(tmp_path):
    made = Archive(tmp_path)
    # Of the first two, one errs to the left and one to the right; the others err as the first.
    drifts = [0.010, -0.012, 0.011, 0.0105]
    for name in ("a", "b", "c"):
        made.write_frames(name, frames())
        for number, drift in enumerate(drifts):
            made.write(name, number, trial(number, drift))
    return made


def test_a_set_that_errs_the_other_way_adds_most(archive):
    worth = Portfolio(archive, ["a", "b", "c"], LENGTH, 2)([0, 1, 2, 3])
    assert int(np.argmin(worth)) in (0, 1)  # together they are the bank
    # By itself, it is the worst.
    assert worth[1] < min(worth[2:]) - 1.0


def test_a_set_that_was_not_run_everywhere_adds_nothing(archive):
    archive.write("a", 4, trial(4, -0.010))
    worth = Portfolio(archive, ["a", "b", "c"], LENGTH, 2)([0, 1, 2, 3, 4])
    assert worth[4] == max(worth)
    assert Portfolio(archive, ["a", "b", "c"], LENGTH, 2)([4]) == [0.0]


def test_of_one_sequence_the_weights_are_its_own(archive):
    worth = Portfolio(archive, ["a"], LENGTH, 2)([0, 1, 2, 3])
    assert worth[1] < min(worth[2:])


def test_the_loss_is_that_on_the_sequences_left_out():
    opposite = np.array([[1.0, -0.9], [-0.9, 1.0]])
    alike = np.array([[1.0, 0.9], [0.9, 1.0]])
    assert loss(np.array([opposite, opposite]), [0, 1]) < loss(np.array([alike, alike]), [0, 1])
    # A member that is good in one of two places gets the wrong weight in both.
    good_here, bad_there = np.diag([1.0, 0.01]), np.diag([1.0, 100.0])
    assert loss(np.array([good_here, bad_there]), [0, 1]) > 0.0
    assert loss(np.array([good_here, bad_there]), [0]) == 0.0


def test_where_nobody_errs_nothing_is_to_be_gained(tmp_path):
    made = Archive(tmp_path)
    made.write_frames("a", frames())
    for number in range(3):
        made.write("a", number, trial(number, 0.0))
    worth = Portfolio(made, ["a"], LENGTH, 2)([0, 1, 2])
    assert np.isfinite(worth).all()
    assert len(set(worth)) == 1


def test_worth_is_of_the_trials_that_are_named(archive):
    """A resumed search finds later trials in the archive, and a search its own of before."""
    portfolio = Portfolio(archive, ["a", "b", "c"], LENGTH, 2)
    before = portfolio([0, 1, 2])
    assert len(set(portfolio([0, 1, 2, 3])) - set(before)) > 0
    assert portfolio([0, 1, 2]) == before
    assert Portfolio(archive, ["a", "b", "c"], LENGTH, 2)([2, 0, 1]) == [
        before[2],
        *before[:2],
    ]


def test_the_bank_is_that_of_the_definition(tmp_path):
    """By trial of every set, and weights from the mean of the other sequences."""
    rng = np.random.default_rng(4)
    drifts = {name: rng.uniform(-0.02, 0.02, 7) for name in ("a", "b", "c")}
    made = Archive(tmp_path)
    for name, of in drifts.items():
        made.write_frames(name, frames())
        for number, drift in enumerate(of):
            made.write(name, number, trial(number, drift))
    every = np.array([*drifts.values()])
    order = np.argsort(np.abs(every).mean(axis=0))  # the fixed set first
    # Errors are the same on all frames, so their mean products are products of the drifts.
    clipped = np.clip(every, *(sign * 6.0 * abs(every[:, order[:1]]) for sign in (-1, 1)))
    squares = np.einsum("sj,sk->sjk", clipped, clipped) / every[:, order[0], None, None] ** 2

    def loss_of(members):
        ratios = []
        for s in range(3):
            mean = np.delete(squares, s, axis=0).mean(axis=0)[np.ix_(members, members)]
            w = minimum_variance_weights(mean)
            ratios.append(np.log(np.sqrt(w @ squares[s][np.ix_(members, members)] @ w)))
        return np.mean(ratios)

    bank = [order[0]]
    while len(bank) < 3:
        bank.append(min(set(range(7)) - set(bank), key=lambda j: loss_of([*bank, j])))
    expected = [loss_of([*[m for m in bank if m != j][:2], j]) for j in range(7)]
    found = Portfolio(made, [*drifts], LENGTH, 3)([*range(7)])
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert np.argmin(found) in bank


@given(
    factors=st.lists(st.floats(-3.0, 3.0), min_size=12, max_size=12),
    scale=st.floats(0.1, 10.0),
)
def test_the_loss_knows_ratios_alone(factors, scale):
    vectors = np.reshape(factors, (2, 3, 2)) + 0.01 * np.eye(3, 2)
    squares = vectors @ vectors.transpose(0, 2, 1) + 1e-3 * np.eye(3)
    one = loss(squares, [0, 1, 2])
    assert loss(scale**2 * squares, [0, 1, 2]) == pytest.approx(one + np.log(scale), abs=1e-5)
    assert loss(squares, [2, 0, 1]) == pytest.approx(one, abs=1e-5)
