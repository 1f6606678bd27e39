import dataclasses
import json
import os
import tracemalloc

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from random_models import assert_same, random_model, refused, rewrite, saved

from adaptune.model import ErrorModel, ModelError
from adaptune.model.error_model import FORMAT
from adaptune.model.rules import Costs, SetCost
from adaptune.space import ODOMETRY, ParameterSets, PooledSpace


def test_knows_the_sensors_of_its_training():
    model = dataclasses.replace(random_model(), elevations=[-30.7, -15.0])
    assert [model.is_foreign(e) for e in (-33.0, -25.0, -16.0, 0.0)] == [False, True, False, True]
    model = dataclasses.replace(model, elevations=[])
    assert not model.is_foreign(0.0)  # where nothing is known, nothing is said


def test_members_of_a_bank_are_the_candidates():
    model = random_model()
    data = model.training_data(model.pca())
    assert data.sequence.tolist() == model.sequence.tolist()
    assert (data.fixed, data.candidates) == (4, None)
    data = model.training_data(model.pca(), [10, 4])
    assert (data.fixed, data.candidates) == (10, (10, 4))
    np.testing.assert_array_equal(data.vectors, model.vectors[:, ::-1])


def several_odometries():
    sets = random_model().sets
    own = tuple({ODOMETRY: "ab"[i % 2]} | one for i, one in enumerate(sets.parameters))
    return ParameterSets(PooledSpace({"a": sets.space, "b": sets.space}), sets.trials, own)


@pytest.mark.parametrize(
    "given",
    [
        {},
        {
            "errors": np.where(np.arange(6) < 3, random_model().errors, np.float32(np.nan)),
            "blocks": {"mine:shape": 88, "two": 2},
            "window": 3,
            "descriptors": np.random.default_rng(1).normal(size=(50, 90)).astype(np.float32),
            "segment": np.arange(50) // 7,
            "expected": {"loss": -0.2, "n_segments": 4.0},
        },
        {"sets": several_odometries()},
    ],
)
def test_a_model_survives_bit_for_bit(tmp_path, given):
    model = dataclasses.replace(random_model(), **given)
    path = saved(tmp_path, **given)
    loaded = ErrorModel.load(path)
    assert_same(loaded, model)
    assert list(tmp_path.iterdir()) == [path]
    loaded.save(tmp_path / "again.safetensors")
    assert_same(ErrorModel.load(tmp_path / "again.safetensors"), model)


def test_the_digest_is_of_what_selections_depend_on(tmp_path):
    model = random_model()
    assert ErrorModel.load(saved(tmp_path)).digest == model.digest
    assert dataclasses.replace(model, provenance={}).digest == model.digest
    errors = model.errors.copy()
    errors[3, 4] += 1
    segment = np.arange(50) // 7
    for other in (
        *({"fixed": 0}, {"window": 2}, {"errors": errors}),
        *({"blocks": {"mine": 90}}, {"segment": segment}),
    ):
        assert dataclasses.replace(model, **other).digest != model.digest


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.99, 0.9999])
def test_a_file_cut_short_is_refused(tmp_path, share):
    path = saved(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    refused(path)


@pytest.mark.parametrize(("other", "word"), [(1, "newer"), (-1, "older")])
def test_another_format_is_refused_by_name(tmp_path, other, word):
    path = saved(tmp_path)
    rewrite(path, text={"version": "7.8.9", "format": FORMAT + other})
    message = refused(path)
    assert "7.8.9" in message
    assert word in message


@pytest.mark.parametrize(
    "changes",
    [
        {"fixed": 1},
        {"trials": [0, 2, 4, 6, 8, 8]},
        {"bank": [4, 5]},
        {"sequences": ["cave"]},
        {"sets": [{"distance": 4.0, "points": 3, "kernel": "none"}] * 5},
        {"sets": [{"distance": 99.0, "points": 3, "kernel": "none"}] * 6},
        {"space": {"distance": {"type": "float", "low": 3}}},
        {"length": 0.0},
        {"blocks": {"ndt": 80}},
        {"window": 0},
        {"costs": {"evidence": 0.0}},
        {"costs": {"evidence": 0.0, "sets": {"0": [1.0]}}},
        *(
            {"arrays": arrays}
            for arrays in (
                {"descriptors": np.zeros((49, 90), np.uint16)},
                {"sequence": np.zeros(49, np.uint32)},
                {"sequence": np.full(50, 2, np.uint32)},
                {"errors": np.zeros(50, np.float32)},
                {"errors": np.full((50, 6), np.nan, np.float32)},
                {"errors": np.full((50, 6), -1.0, np.float32)},
                {"descriptors": np.full((50, 90), np.nan, np.float32)},
            )
        ),
    ],
)
def test_parts_that_do_not_go_together_are_refused(tmp_path, changes):
    path = saved(tmp_path)
    rewrite(path, **changes)
    refused(path)


def peak(path):
    """Bytes taken at most while a file is loaded, or refused."""
    tracemalloc.start()
    try:
        with pytest.raises(ModelError):
            ErrorModel.load(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "shape", [[10**6, 10**6], [2**31, 2], [-1, 6], [2**64, 2**64], [50, 7], [300], [], [50, 0]]
)
def test_shapes_that_the_file_does_not_bear_out_are_refused(tmp_path, shape):
    path = saved(tmp_path)
    content = path.read_bytes()
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["errors"]["shape"] = shape
    text = json.dumps(header).encode()
    path.write_bytes(len(text).to_bytes(8, "little") + text + content[8 + size :])
    assert peak(path) < 2_000_000


@pytest.mark.parametrize("size", [0, 1, 10**6, 2**31, 2**63, 2**64 - 1])
def test_a_header_that_is_said_to_be_longer_than_the_file_is_refused(tmp_path, size):
    path = saved(tmp_path)
    path.write_bytes(size.to_bytes(8, "little") + path.read_bytes()[8:])
    assert peak(path) < 2_000_000


def attempt(path):
    """A model, or the sentence that refuses it, in which the file is named."""
    try:
        return ErrorModel.load(path), str(path)
    except ModelError as error:
        return None, str(error)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_whatever_happens_to_the_bytes_a_sentence_is_all_that_comes_of_it(tmp_path, data):
    path = saved(tmp_path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        # Most of a file is numbers: its header is where it is fragile.
        at = data.draw(st.integers(0, len(content)) | st.integers(0, 700))
        length = data.draw(st.integers(0, 40))
        content[at : at + length] = data.draw(st.binary(max_size=40))
    path.write_bytes(content)
    tracemalloc.start()
    loaded, message = attempt(path)
    taken = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert taken < 4_000_000
    assert str(path) in message
    assert "\n" not in message
    if loaded is not None:
        assert_same(loaded, random_model())


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_any_header_is_understood_or_refused(tmp_path, data):
    path = saved(tmp_path)
    json_values = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
        max_leaves=5,
    )
    keys = ["space", "trials", "sets", "bank", "fixed", "length", "sequences", "blocks", "window"]
    rewrite(path, **{data.draw(st.sampled_from(keys)): data.draw(json_values)})
    _, message = attempt(path)
    assert str(path) in message


def test_costs_a_budget_and_what_is_recommended_survive(tmp_path):
    model = random_model()
    costs = Costs({n: SetCost(n + 0.1, 2.5, n % 2) for n in model.sets}, 0.25)
    given = {"costs": costs, "recommended": "adaptive", "bank_size": 4, "budget": "3x"}
    given["milliseconds"] = 9.0
    path = saved(tmp_path, **given)
    loaded = ErrorModel.load(path)
    assert_same(loaded, dataclasses.replace(model, **given))
    # Live evidence included, but for the fixed set.
    assert loaded.allowed() == (0, 2, 4, 6)
    assert loaded.training_data(loaded.pca()).allowed == (0, 2, 4, 6)


def test_evidence_is_of_segments():
    model = random_model()
    assert model.training_data(model.pca()).sequence.max() == 1
    segment = np.arange(50) // 25
    cut = dataclasses.replace(model, segment=segment)
    number = cut.training_data(cut.pca()).sequence
    np.testing.assert_array_equal(number, 2 * model.sequence + segment)


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o027, 0o640), (0o002, 0o664)])
def test_others_may_read_it_as_far_as_the_umask_lets_them(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        path = saved(tmp_path)
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == mode
