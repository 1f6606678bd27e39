"""A selection rule of the user's own, from his working folder, in every command."""

import re
import shutil

import numpy as np
import pytest
import users_rule
from made_replays import folder_of

from adaptune._system import manifest
from adaptune._system.strict import ConfigurationError
from adaptune.model import ErrorModel, ModelError
from adaptune.model.registry import RuleError, rule_class
from adaptune.runs.files import read_run
from adaptune.selector import Selector
from adaptune.tuning.tuned import write_comparison
from offline.config import load_study
from offline.scenario import scenario
from offline.validate import validate
from online.compare import compare
from online.modes import run_replays


@pytest.fixture
def study(study_file, trained_folder, tmp_path, monkeypatch):
    shutil.copy(users_rule.__file__, tmp_path / "my_rules.py")
    monkeypatch.syspath_prepend(tmp_path)
    folder = shutil.copytree(trained_folder, tmp_path / "study")
    return load_study(study_file, ["online.modes=[my_rules:Cheapest, adaptive]"], folder)


def test_it_is_validated_replayed_compared_and_shown(study, study_file, tmp_path, monkeypatch):
    mode = "my_rules:Cheapest"
    found = validate(study)
    assert mode in found.validation.modes
    costs = ErrorModel.load(study.model_path).costs
    least = min(costs.sets, key=costs.alone)
    assert found.validation.cost(mode) == pytest.approx(costs.alone(least))
    assert found.verdicts[-1].startswith(f"`{mode}`")

    run_replays(study, study.model_path)
    replay = read_run(folder_of(study, mode))
    assert np.unique([choice.selection.trial for choice in replay.choices]).tolist() == [least]
    assert run_replays(study, study.model_path) == 0

    rows = write_comparison(study)[0].rows
    assert [row.mode for row in rows] == ["baseline", "fixed", "adaptive", mode]
    monkeypatch.setattr("online.compare.decided", lambda *_: rows[-1])
    assert compare(study).advised == mode
    page = (study.folder / "report/report.html").read_text()
    assert "the set that costs least, wherever it is" in page

    # Another rule under the same name is another replay.
    with (tmp_path / "my_rules.py").open("a") as file:
        file.write("# changed\n")
    again = load_study(study_file, ["online.modes=[my_rules:Cheapest]"], study.folder)
    assert run_replays(again, again.model_path) == 1
    about = manifest.recorded(folder_of(again, mode) / manifest.FILE)
    assert about["rule"]


def test_it_chooses_among_the_members_of_a_bank(study):
    model = ErrorModel.load(study.model_path)
    members = model.bank[:2]
    assert len(members) < len(model.sets)
    assert Selector(model, "my_rules:Cheapest", members).members == tuple(members)
    with pytest.raises(ModelError, match=r"Outside: selects trial .* choose among data.candidates"):
        Selector(model, "my_rules:Outside", members)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("NoSelf", None),
        ("Empty", "Empty.select: returns None; return Selection(trial, data.sets[trial])"),
        ("Number", "Number.select: returns 3; return"),
        ("Unknown", "Unknown.select: returns Selection(trial=999, "),
        ("OtherValues", "OtherValues.select: returns Selection(trial="),
        ("Weights", "Weights.select: returns Selection(trial="),
        ("OneArgument", "takes 2 positional arguments but 3 were given"),
        ("Maker", "missing 1 required positional argument: 'k'"),
        ("Raises", "Raises.fit: AttributeError: 'TrainingData' object has no attribute 'nothing'"),
    ],
)
def test_what_a_rule_does_wrong_is_told_by_its_name(study, name, words):
    model, mode = ErrorModel.load(study.model_path), f"my_rules:{name}"
    if words is None:
        assert Selector(model, mode, ()).select is not None
        assert scenario(study).score(getattr(users_rule, name)()) is not None
        return
    with pytest.raises(RuleError, match=re.escape(words)):
        Selector(model, mode, ())
    if name == "Weights":  # it has no bank to weigh there
        return
    with pytest.raises(RuleError, match=re.escape(words)):
        validate(load_study(study.folder / "study.yaml", [f"online.modes=[{mode}]"], study.folder))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("adaptiv", "there is no mode 'adaptiv': did you mean 'adaptive'?"),
        ("my_rules:Nothing", "my_rules:Nothing: my_rules has no Nothing"),
        ("nowhere:Rule", "nowhere:Rule: cannot import nowhere"),
        ("my_rules:Other", "my_rules:Other: is not a class derived from adaptune.model.Rule"),
    ],
)
def test_an_unknown_rule_is_one_clear_error(study, study_file, name, words):
    with pytest.raises(ConfigurationError, match=f"online.modes.*{re.escape(words)}"):
        load_study(study_file, [f"online.modes=[{name}]"], study.folder)
    with pytest.raises(RuleError, match=re.escape(words)):
        rule_class(name)
    with pytest.raises(RuleError, match=re.escape(words)):
        Selector(ErrorModel.load(study.model_path), name)
