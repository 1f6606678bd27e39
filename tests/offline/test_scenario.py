import sys

import numpy as np
import pytest

from adaptune.archive import PREPARE_MS, REGISTER_MS, Archive
from adaptune.errors import AdaptuneError
from offline.config import load_study
from offline.scenario import read_scenario, scenario, write_scenario


@pytest.fixture
def study(study_file, trained_folder):
    return load_study(study_file, [], trained_folder)


def same(one, other):
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_it_holds_what_the_archive_does(study):
    found = scenario(study)
    archive = Archive(study.folder / "trials")
    assert found.performances.shape == (len(found.frame), len(found.trial)) == (42, 10)
    for name in ("one", "two"):
        here = found.sequence == name
        errors = archive.read_errors(name, found.trial.tolist())[found.frame[here]]
        np.testing.assert_array_equal(found.performances[here], errors)
    register, prepare = (
        np.array(
            [[archive.finished(n)[t].others[key] for n in ("one", "two")] for t in found.trial]
        )
        for key in (REGISTER_MS, PREPARE_MS)
    )
    # All are prepared alike, so that this costs the same.
    costs = register.mean(axis=1) + np.median(prepare.mean(axis=1))
    np.testing.assert_allclose(found.cost, costs)
    # Two recordings are few: stretches are left out, and none is of both.
    folds = [set(found.fold[found.sequence == name]) for name in ("one", "two")]
    assert folds[0].isdisjoint(folds[1])
    assert found.features.shape == (42, 90)


@pytest.mark.parametrize("name", ["errors.csv", "errors.parquet"])
def test_it_is_read_back(study, tmp_path, name):
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    found = scenario(study)
    found.performances[0, 0] = np.inf
    write_scenario(tmp_path / name, found)
    same(read_scenario(tmp_path / name), found)


def test_mistakes_are_told(study, study_file, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(AdaptuneError, match=r"e\.parquet: Parquet needs pandas and pyarrow"):
        write_scenario(tmp_path / "e.parquet", scenario(study))
    (tmp_path / "e.csv").write_text("a,b\n1,2\n")
    for path in ("e.csv", "none.csv"):
        with pytest.raises(AdaptuneError, match="is no table of errors"):
            read_scenario(tmp_path / path)
    with pytest.raises(AdaptuneError, match="no trial is finished yet"):
        scenario(load_study(study_file, [], tmp_path / "new"))
