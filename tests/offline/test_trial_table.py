from dataclasses import replace
from typing import get_args

import numpy as np
import pytest

from adaptune.errors import AdaptuneError
from adaptune.runs.archive import Archive, Trial
from offline.config import Metric
from offline.trial_table import headings, of_each, rows, select, with_units

STAMPS = 1_700_000_000_123_456_789 + np.arange(20) * 100_000_000


def drive(seed):
    """Poses without rotation."""
    T = np.tile(np.eye(4), (len(STAMPS), 1, 1))
    T[:, :3, 3] = np.random.default_rng(seed).normal(size=(len(STAMPS), 3)).cumsum(axis=0)
    return T


@pytest.fixture
def archive(tmp_path):
    """Trials 0 to 3 on one sequence, 0 on the other."""
    archive = Archive(tmp_path / "trials")
    for seed, (name, number) in enumerate([*(("cave", n) for n in range(4)), ("street", 0)]):
        rng = np.random.default_rng(seed)
        few = rng.random(len(STAMPS)) < 0.2
        parameters = {"distance": rng.random(), "kernel": "Huber"}
        errors = rng.gamma(1.0, size=len(STAMPS))
        archive.write(name, number, Trial.of(parameters, drive(seed), errors, few, 1.0))
    archive.write("cave", 1, archive.read("cave", 0), kind="whole")
    return archive


def test_there_is_a_row_for_every_trial(archive):
    table = rows(archive, ["cave", "street"])
    assert [row["trial"] for row in table] == [0, 1, 2, 3]
    first = archive.read("cave", 0), archive.read("street", 0)
    assert table[0]["mean"] == pytest.approx(np.mean([trial.mean_error for trial in first]))
    assert table[0]["restarts"] == sum(trial.restarted.sum() for trial in first)
    assert table[1]["street"] is None
    assert table[1]["mean"] is None
    assert table[3]["kernel"] == "Huber"
    assert rows(Archive(archive.folder / "none"), ["cave"]) == []


def test_the_cost_is_a_column_and_its_parts_are_none(archive):
    trial = archive.read("cave", 3)
    for name, register in (("cave", 2.0), ("street", 4.0)):
        others = {"register_ms": register, "prepare_ms": 5.0, "memory": 9.0}
        archive.write(name, 4, replace(trial, others=others))
    table = rows(archive, ["cave", "street"])
    assert [row["cost"] for row in table] == [None] * 4 + [8.0]
    assert not {"register_ms", "prepare_ms"} & set(table[4])
    assert table[4]["memory"] == 9.0
    assert "cost [ms]" in with_units(table, ["cave", "street"], {})[0]


def test_what_is_printed_sorts(archive):
    names, labels = ["cave", "street"], {"distance": "distance [m]"}
    table = rows(archive, names)
    shown = headings(names, labels)
    for heading in with_units(table, names, labels)[0]:
        assert len(select(table, f"-{heading}", None, shown)) == len(table)
    by_distance = select(table, "distance [m]", None, shown)
    assert by_distance == sorted(table, key=lambda row: row["distance"])


def test_every_metric_of_an_objective_is_a_column(archive):
    known = {metric: 1.0 for metric in get_args(Metric) if metric not in ("rte", "ms_per_scan")}
    archive.write("cave", 0, replace(archive.read("cave", 0), others=known))
    for metric in get_args(Metric):
        assert len(select(rows(archive, ["cave"]), metric))


TABLE = [
    {"trial": 0, "mean": 2.0, "kernel": "Huber", "deskew": True},
    {"trial": 1, "mean": None, "kernel": "Tukey", "deskew": False},
    {"trial": 2, "mean": 0.5, "kernel": "Huber", "deskew": False},
    {"trial": 3, "mean": 1.0, "kernel": "Tukey", "deskew": True},
]


@pytest.mark.parametrize(
    ("arguments", "numbers"),
    [
        ({}, [0, 1, 2, 3]),
        ({"sort": "mean"}, [2, 3, 0, 1]),
        ({"sort": "-mean"}, [0, 3, 2, 1]),
        ({"top": 2}, [2, 3]),
    ],
)
def test_selecting(arguments, numbers):
    assert [row["trial"] for row in select(TABLE, **arguments)] == numbers


def test_a_column_that_there_is_not_is_told():
    with pytest.raises(AdaptuneError, match=r"--sort means: .* did you mean 'mean'"):
        select(TABLE, "means")


def test_each_of_several_odometries_has_its_own_set_and_its_best():
    of = [("gicp", 4.0), ("ndt", 3.0), ("gicp", 2.0), ("ndt", 1.0), ("gicp", None), ("vgicp", None)]
    table = [
        {"trial": n, "odometry": name, "mean": mean, "cost": 10.0 + n}
        for n, (name, mean) in enumerate(of)
    ]
    found = {name: [row["trial"] for row in both] for name, both in of_each(table).items()}
    assert found == {"gicp": [0, 2], "ndt": [1, 3], "vgicp": [5, 5]}
    assert of_each([row for row in table if row["odometry"] == "ndt"]) == {}
