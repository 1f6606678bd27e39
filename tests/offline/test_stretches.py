from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from labelled_places import in_place, labelled, simulated, with_motions

from adaptune.metrics import travelled, window_ends
from adaptune.study.study import PER_STRETCH

LENGTH = 10.0


def poses(steps, turns):
    """Poses along a plane path."""
    heading = np.cumsum(turns)
    T = np.tile(np.eye(4), (len(steps) + 1, 1, 1))
    T[1:, 0, 3] = np.cumsum(steps * np.cos(heading))
    T[1:, 1, 3] = np.cumsum(steps * np.sin(heading))
    return T


def along(T, name="one"):
    known = window_ends(T, LENGTH) >= 0
    errors = np.zeros((known.sum(), 1), np.float32)
    return in_place(name, simulated(np.zeros((len(T), 1)), None, T), known, errors)


def any_path(seed):
    """A path that winds, and on which the robot stands for a while."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(30, 900))
    steps = rng.uniform(0.0, 1.0, n)
    at = int(rng.integers(0, n))
    steps[at : at + int(rng.integers(0, 50))] = 0.0
    return poses(steps, rng.normal(0.0, 0.1, n))


paths = st.integers(0, 2**32 - 1).map(any_path)


@settings(max_examples=60, deadline=None)
@given(paths)
def test_stretches_share_out_the_frames(T):
    one = along(T)
    numbers = one.stretch
    assert numbers.shape == one.known.shape
    if not len(numbers):
        return
    assert numbers[0] == 0
    assert set(np.diff(numbers)) <= {0, 1}
    distance = travelled(T)[one.known]
    size = PER_STRETCH * LENGTH
    of_stretches = [np.ptp(distance[numbers == n]) for n in np.unique(numbers)]
    # All but the last are as long as they should be, within a step; that is half as long at least,
    # unless it is the only one.
    assert all(size - 2.0 <= length <= size for length in of_stretches[:-1])
    if len(of_stretches) > 1:
        assert 0.5 * size - 2.0 <= of_stretches[-1] <= 1.5 * size
    else:
        assert of_stretches[0] <= 1.5 * size


@settings(max_examples=60, deadline=None)
@given(paths, st.integers(0, 9))
def test_nothing_that_is_known_comes_near_to_what_is_left_out(T, which):
    one = along(T)
    if not len(one.known):
        return
    left = one.frames(one.stretch == which % (one.stretch.max() + 1))
    kept = one.frames(~one.near(left))
    # Sub-trajectories that begin where the other ends have a frame in common.
    first, last = left.known.min(), left.ends.max()
    assert not ((kept.known <= last) & (kept.ends >= first)).any()
    apart = np.linalg.norm(kept.positions[:, None] - left.positions[None], axis=-1)
    assert (apart > LENGTH).all()
    # Nothing else is dropped.
    dropped = one.frames(one.near(left))
    apart = np.linalg.norm(dropped.positions[:, None] - left.positions[None], axis=-1).min(axis=1)
    overlaps = (dropped.known <= last) & (dropped.ends >= first)
    assert (overlaps | (apart <= LENGTH)).all()


def test_a_view_that_is_played_backwards_is_cut_as_its_recording():
    T = poses(np.full(400, 0.5), np.zeros(400))
    recording = along(T)
    view = along(T[::-1], "one+reverse").cut_as(recording)
    at = np.linspace(11.0, 189.0, 30)
    for x in at:
        frame = np.abs(recording.positions[:, 0] - x).argmin()
        same = np.abs(view.positions[:, 0] - x).argmin()
        assert view.stretch[same] == recording.stretch[frame]
    left = recording.frames(recording.stretch == 2)
    kept = view.frames(~view.near(left))
    first, last = left.positions[:, 0].min(), T[left.ends, 0, 3].max()
    # It goes from its start back to its end.
    end_positions = T[::-1][kept.ends, 0, 3]
    assert ((kept.positions[:, 0] < first) | (end_positions > last - LENGTH)).all()
    assert len(kept.known)


def test_with_six_recordings_whole_ones_are_left_out():
    rng = np.random.default_rng(3)
    sequences = [with_motions(f"s{i}", rng, 500) for i in range(6)]
    assert len(labelled(sequences).folds()) == 6
    for left, others in labelled(sequences).folds():
        assert [s.name for s in others.sequences] == [
            f"s{i}" for i in range(6) if f"s{i}" != left.name
        ]
        assert len(np.unique(others.stretches())) == 5 * 3
    folds = labelled(sequences[:5]).folds()
    assert len(folds) == 5 * 3
    for left, others in folds:
        assert [s.name for s in others.sequences] == [f"s{i}" for i in range(5)]
        (same,) = [s for s in others.sequences if s.name == left.name]
        assert not set(np.unique(left.stretch)) & set(np.unique(same.stretch))


def test_parts_of_a_recording_are_one_recording():
    rng = np.random.default_rng(3)
    one = with_motions("s0", rng, 500)
    parts = [replace(one, name=f"s{i}", recording="drive.bag") for i in range(6)]
    data = labelled(parts)
    assert data.recordings == ["drive.bag"]
    # So stretches are left out; here all parts show the same place, so none of it is known.
    folds = data.folds()
    assert len(folds) == 6 * 3
    for left, others in folds:
        numbers = {int(n) for s in others.sequences for n in np.unique(s.stretch)}
        assert int(left.stretch[0]) not in numbers
    assert data.folds(by_recording=True) == []
    other = labelled([*parts[:2], replace(one, name="other", recording="other")])
    names = [[s.name for s in others.sequences] for _, others in other.folds(by_recording=True)]
    assert names == [["other"], ["other"], ["s0", "s1"]]


def test_a_stretch_takes_its_part_of_everything():
    one = with_motions("one", np.random.default_rng(3), 500)
    n = len(one.errors)
    whole_errors = {0: np.linspace(0.0, 1.0, n), 3: np.full(n, 50.0)}
    one = replace(
        one,
        baseline=np.arange(n, dtype=float),
        values=np.ones(5),
        repeats=np.ones((5, 3)),
        whole={0: 0.5, 3: 30.0},
        whole_errors=whole_errors,
    )
    kept = one.stretch == 1
    some = one.frames(kept)
    assert some.whole == {0: pytest.approx(whole_errors[0][kept].mean()), 3: 30.0}
    # The objective follows from the errors.
    assert some.values is None
    assert some.repeats is None
    assert len(some.baseline) == len(some.period) == len(some.errors) == kept.sum()
    assert {len(of) for of in some.vectors.values()} == {kept.sum()}
    other = replace(one, whole_errors=None).frames(kept)
    assert (other.whole, len(other.values)) == (one.whole, 5)
    assert one.frames(np.ones(n, bool)) is one
    cut_again = some.frames(np.arange(kept.sum()) < 5)
    np.testing.assert_array_equal(cut_again.known, np.flatnonzero(kept)[:5])
