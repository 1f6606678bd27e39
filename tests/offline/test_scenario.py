import json
import shutil
import sys

import fake_odometry
import numpy as np
import pytest

from adaptune.errors import AdaptuneError
from adaptune.metrics import cap
from adaptune.model import ErrorModel, Rule
from adaptune.model.knn import NearestNeighbours
from adaptune.model.rules import BASELINE
from adaptune.runs.archive import PREPARE_MS, REGISTER_MS, Archive
from adaptune.space import Selection
from offline.config import load_study
from offline.scenario import read_scenario, scenario, write_scenario


@pytest.fixture
def study(study_file, trained_folder):
    return load_study(study_file, [], trained_folder)


def same(one, other):
    for name, a, b in zip(one._fields, one, other, strict=True):
        if name == "sets":
            assert (a.space, a.trials, a.parameters) == (b.space, b.trials, b.parameters)
        else:
            np.testing.assert_array_equal(a, b)


def test_it_holds_what_the_archive_does(study):
    found = scenario(study)
    archive = Archive(study.folder / "trials")
    assert found.performances.shape == (len(found.frame), len(found.sets)) == (58, 10)
    for name in ("one", "two"):
        here = found.sequence == name
        errors = archive.read_errors(name, list(found.sets))[found.frame[here]]
        np.testing.assert_array_equal(found.performances[here], errors)
    register, prepare = (
        np.array([[archive.finished(n)[t].others[key] for n in ("one", "two")] for t in found.sets])
        for key in (REGISTER_MS, PREPARE_MS)
    )
    # All are prepared alike, so that this costs the same.
    costs = register.mean(axis=1) + np.median(prepare.mean(axis=1))
    np.testing.assert_allclose(found.cost, costs)
    # Two recordings are few: segments are left out, and none is of both.
    folds = [set(found.fold[found.sequence == name]) for name in ("one", "two")]
    assert folds[0].isdisjoint(folds[1])
    assert found.features.shape == (58, 90)


class Baseline(Rule):
    def fit(self, data):
        self.data = data
        return self

    def select(self, feature, evidence=None):  # noqa: ARG002
        return Selection(BASELINE, self.data.sets[BASELINE])


class Fixed(Baseline):
    def select(self, feature, evidence=None):  # noqa: ARG002
        return Selection(self.data.fixed, self.data.sets[self.data.fixed])


class Cheapest(Baseline):
    def select(self, feature, evidence=None):  # noqa: ARG002
        best = min(self.data.candidates or self.data.sets, key=self.data.costs.alone)
        return Selection(best, self.data.sets[best])


class Outside(Baseline):
    def select(self, feature, evidence=None):  # noqa: ARG002
        other = next(trial for trial in self.data.sets if trial not in self.data.candidates)
        return Selection(other, self.data.sets[other])


class Best(Baseline):
    """Sees the error of the very frame, which no fold that is left out may show."""

    def select(self, feature, evidence=None):  # noqa: ARG002
        (frame,) = np.flatnonzero((self.data.features == feature).all(axis=1))
        return Selection(self.data.sets.trials[frame], self.data.sets[0])


def errors(found, rule):
    return cap(found.performances)[np.arange(58), found.select(rule)]


def test_a_table_of_rules_has_what_they_compare_with(study):
    found = scenario(study)
    rows = {row["rule"]: row for row in found.score(Baseline(), Fixed())}
    assert list(rows) == ["Baseline", "Fixed", "fixed", "best single set", "oracle"]
    some = [found.sets.column(trial) for trial in found.candidates]
    clipped = cap(found.performances)[:, some]
    assert rows["oracle"]["RTE [%]"] == pytest.approx(clipped.min(axis=1).mean())
    assert rows["best single set"]["RTE [%]"] == pytest.approx(clipped.mean(axis=0).min())
    assert rows["Fixed"] | {"rule": "fixed"} == rows["fixed"]
    assert rows["fixed"]["vs fixed"] == 1.0
    assert rows["Baseline"]["cost [ms]"] == pytest.approx(found.cost[0])
    assert rows["Baseline"]["RTE [%]"] == pytest.approx(errors(found, Baseline()).mean())


def test_candidates_are_those_of_online(study, monkeypatch):
    model = ErrorModel.load(study.model_path)
    assert scenario(study).candidates == tuple(model.allowed() or model.sets)
    # An odometry that cannot change live has a bank.
    monkeypatch.setattr(type(study.odometry.description), "live", False, raising=False)
    found = scenario(study)
    members = {model.fixed, *model.bank} - ({*model.reserve} - {model.fixed})
    assert set(found.candidates) == members
    assert np.isin(found.select(Cheapest()), [found.sets.column(n) for n in members]).all()
    with pytest.raises(AdaptuneError, match=r"Outside: selects trial \d+, which is none of data"):
        found.select(Outside())


def test_rules_are_scored_without_an_odometry(study):
    found = scenario(study)
    baseline, fixed = errors(found, Baseline()), errors(found, Fixed())
    np.testing.assert_array_equal(baseline, found.performances[:, 0])
    assert not np.array_equal(fixed, baseline)
    cheapest = errors(found, Cheapest())
    some = [found.sets.column(trial) for trial in found.candidates]
    least = some[int(found.cost[some].argmin())]
    np.testing.assert_array_equal(cheapest, cap(found.performances)[:, least])
    with pytest.raises(AdaptuneError, match=r"Cheapest: is a class; give an object, Cheapest\(\)"):
        found.score(Cheapest)
    near = errors(found, NearestNeighbours(k=3))
    assert near.shape == (58,)
    assert np.isin(near, cap(found.performances)).all()
    with pytest.raises(AdaptuneError, match=r"Best\.select: ValueError: not enough values"):
        found.score(Best())
    for folds in (np.zeros(58, np.intp), np.arange(58) % 2):
        with pytest.raises(AdaptuneError, match="nothing is left to learn from"):
            found._replace(fold=folds).score(Baseline())


def test_a_bank_is_not_scored(study):
    class Bank(Baseline):
        def select(self, feature, evidence=None):  # noqa: ARG002
            return super().select(feature)._replace(weights={0: 1.0})

    with pytest.raises(AdaptuneError, match=r"Bank: weighs a bank: .* `adaptune validate`"):
        scenario(study).score(Bank())


def test_frames_that_overlap_a_fold_are_left_out_with_it(study):
    found, seen = scenario(study), []
    parts = np.select([found.sequence == "two", found.frame < found.frame.min() + 4], [2, 1], 0)
    found = found._replace(fold=parts)

    class Seen(Baseline):
        def fit(self, data):
            seen.append(len(data.features))
            return super().fit(data)

    found.score(Seen())
    for fold, n in zip(np.unique(found.fold), seen, strict=True):
        left_out, here = found.fold == fold, (found.sequence == "two") == (fold == 2)
        first, last = found.frame[left_out].min(), found.end[left_out].max()
        apart = ~here | (found.frame > last) | (found.end < first)
        assert n == apart.sum()
        assert fold == 2 or n < (~left_out).sum()


@pytest.mark.parametrize("name", ["errors.csv", "errors.parquet"])
def test_it_is_read_back(study, tmp_path, name):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    found = scenario(study)
    found.performances[0, 0] = np.inf
    write_scenario(tmp_path / name, found)
    same(read_scenario(tmp_path / name), found)


def test_columns_are_found_by_their_names(study, tmp_path):
    write_scenario(tmp_path / "a.csv", found := scenario(study))
    header, *rows = (line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines())
    order = sorted(range(len(header)), key=lambda i: header[i], reverse=True)
    turned = [["feature_x", *(row[i] for i in order)] for row in (header, *rows)]
    (tmp_path / "a.csv").write_text("".join(",".join(row) + "\n" for row in turned))
    about = json.loads((tmp_path / "a_sets.json").read_text())
    about["sets"] = [dict(reversed(one.items())) for one in about["sets"]]
    (tmp_path / "a_sets.json").write_text(json.dumps(about))
    same(read_scenario(tmp_path / "a.csv"), found)


def test_it_is_read_without_the_class_of_the_odometry(study, tmp_path):
    folder = shutil.copytree(study.folder, tmp_path / "study")
    text = (folder / "study.yaml").read_text()
    assert fake_odometry.NAME in text
    (folder / "study.yaml").write_text(text.replace(fake_odometry.NAME, "gone:Fake"))
    with pytest.raises(AdaptuneError, match="cannot import gone"):
        load_study(folder)
    found = scenario(load_study(folder, needed=False))
    np.testing.assert_array_equal(found.performances, scenario(study).performances)
    with pytest.raises(AdaptuneError, match="cannot import gone"):
        load_study(folder)


def test_mistakes_are_told(study, study_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(AdaptuneError, match=r"e\.parquet: Parquet needs pandas and pyarrow"):
        write_scenario(tmp_path / "e.parquet", scenario(study))
    (tmp_path / "e.csv").write_text("a,b\n1,2\n")
    for path in ("e.csv", "none.csv"):
        with pytest.raises(AdaptuneError, match="is no table of errors"):
            read_scenario(tmp_path / path)
    write_scenario(tmp_path / "f.csv", scenario(study))
    (tmp_path / "f_sets.json").write_text("{")
    words = r"f\.csv, with f_sets\.json beside it: is no table of errors: "
    with pytest.raises(AdaptuneError, match=words):
        read_scenario(tmp_path / "f.csv")
    with pytest.raises(AdaptuneError, match="no trial is finished yet"):
        scenario(load_study(study_file, [], tmp_path / "new"))
