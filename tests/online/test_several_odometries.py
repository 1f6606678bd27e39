"""A study of two odometries from its trials to its comparison."""

import csv

import pytest
from drives import study_with

from adaptune._system import yaml12
from adaptune.model import ErrorModel
from adaptune.runs.archive import Archive
from adaptune.space import ODOMETRY, PooledSpace
from adaptune.study.driven import driven
from offline.config import load_study
from offline.labelled import labelled_data
from offline.train import train
from online.compare import compare
from online.modes import run_replays
from online.tables import tables
from online.verdict import remarks

ODOMETRIES = """\
odometry:
  - {name: gicp, settings: {min_range: 0.5, iterations: 10}}
  - {name: vgicp, settings: {min_range: 0.5, iterations: 10}}
"""


@pytest.fixture(scope="module")
def load(study_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("several")
    path = folder / "several.yaml"
    online = "online: {modes: [adaptive], switching: {mechanism: bank}}\n"
    path.write_text(study_with(ODOMETRIES, study_file.parent) + online)
    return lambda *overrides: load_study(path, list(overrides), folder / "study")


@pytest.fixture(scope="module")
def trained(load):
    study = load()
    return study, train(study)


def test_the_trials_range_over_both(trained):
    study, training = trained
    sets = training.model.sets
    assert isinstance(sets.space, PooledSpace)
    assert sets.defaults == [0, 1]
    assert {s[ODOMETRY] for s in sets.parameters} == {"gicp", "vgicp"}
    archive = Archive(study.folder / "trials")
    for name in study.training:
        # The baselines of both are driven whole.
        for trial in (0, 1):
            assert archive.read(name, trial, kind="whole").parameters == sets[trial]
            assert archive.finished(name)[trial].cost > 0.0
        assert archive.read_frames(name).evidence_ms > 0.0
    rows = list(csv.DictReader((study.folder / "trials.csv").open()))
    assert all((row["resolution"] == "") == (row[ODOMETRY] == "gicp") for row in rows)
    assert all(float(row["cost [ms]"]) > 0.0 for row in rows)
    fixed = yaml12.Document((study.folder / "fixed.yaml").read_text()).data
    assert fixed == sets[training.model.fixed]


def test_the_model_knows_what_its_sets_cost(trained):
    study, training = trained
    model = ErrorModel.load(study.model_path)
    assert model.costs == training.model.costs
    assert set(model.costs.sets) == set(model.sets)
    numbers = [model.costs.sets[t].preparation for t in model.sets]
    downsampling = [model.sets[t]["downsampling"] for t in model.sets]
    # Both odometries share prepared clouds.
    assert (
        len(set(numbers))
        == len(set(downsampling))
        == len({*zip(numbers, downsampling, strict=True)})
    )
    assert f"({model.sets[model.fixed][ODOMETRY]})" in driven(
        model, study.config.online, study.odometry, study.mechanism
    )


def test_it_is_replayed_and_compared(trained):
    study, _ = trained
    modes = ["baseline", "fixed", "adaptive"]
    assert run_replays(study, study.model_path) == len(modes)
    rows = compare(study).rows
    assert list(dict.fromkeys(row.mode for row in rows)) == modes
    assert all(row.run.cpu_ms > 0.0 and row.run.memory_mb > 0.0 for row in rows)
    assert tables(rows, 3.0)
    assert not [said for said in remarks(rows) if "CPU time" in said]
    assert run_replays(study, study.model_path) == 0


def test_another_budget_runs_no_trial(trained, load):
    study, training = trained
    sets, costs = training.model.sets, training.model.costs
    # By the trials, and as finalists cost side by side. A cheaper set may lose track without the
    # health check, a default of the odometries is always there.
    of_trials = labelled_data(study, Archive(study.folder / "trials"), sets).costs
    budget = 1.01 * max(of.alone(n) for of in (costs, of_trials) for n in sets.defaults)
    study = load(f"online.budget={budget}")
    before = len(list(study.folder.glob("trials/*/*.npz")))
    model = train(study).model
    # The whole run of another fixed set may be added.
    assert len(list(study.folder.glob("trials/*/*[0-9].npz"))) <= before
    assert model.costs.alone(model.fixed) <= budget
    assert model.budget == pytest.approx(budget)
