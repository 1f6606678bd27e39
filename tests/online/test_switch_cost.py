import json
import shutil
from dataclasses import replace

import pytest

from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel
from offline.config import load_study
from online import switch_cost


def test_the_switch_cost_of_every_mechanism(study_file, tmp_path, monkeypatch):
    monkeypatch.setattr(switch_cost, "PERIOD", 1.0)
    given = ["online.switching.mechanism=hand_over", "online.switching.warm_up=0.3"]
    study = load_study(study_file, given, tmp_path)
    seen = []
    rows, caption = switch_cost.measure_switching(study, 10.0, lambda *step: seen.append(step))
    ratios = {row["mechanism"]: row["RTE ratio"] for row in rows}
    # All of the drive lies within every warm-up but the last.
    assert list(ratios) == [
        "none",
        "live",
        "hand_over, 4 s",
        "hand_over, 8 s",
        "hand_over, 12 s",
        "hand_over, 0.3 s",
        "bank",
    ]
    said = "Switches every 1 s to the same set, on the first 10 s of each training sequence: "
    assert caption.startswith(f"{said}23 m in all. That is less than 10 sub-trajectories of 3 m")
    short = load_study(study_file, [*given, "sub_trajectory=2"], tmp_path / "short")
    monkeypatch.setattr(switch_cost, "WARM_UPS", ())
    assert switch_cost.measure_switching(short, 10.0)[1] == f"{said}23 m in all."
    assert ratios["none"] == 1.0
    assert ratios["live"] == pytest.approx(1.0, abs=1e-3)
    assert ratios["bank"] == pytest.approx(1.0, abs=1e-9)
    assert ratios["hand_over, 0.3 s"] != 1.0
    assert all(row["ms a scan"] > 0 for row in rows)
    assert seen[-1][0] == "two, bank"
    assert seen[-1][1:] == (40, 40)
    kept = json.loads((tmp_path / "switching.json").read_text())
    assert kept["switch_cost"] == pytest.approx(ratios["hand_over, 0.3 s"] - 1.0)
    assert study.switch_cost() == max(0.0, kept["switch_cost"])


def test_what_is_not_driven_has_no_switch_cost(study_file, trained_folder, tmp_path, monkeypatch):
    folder = shutil.copytree(trained_folder, tmp_path / "study")
    study = load_study(study_file, ["online.switching.cores=2"], folder)
    found = {"of": study.switching_identity(), "switch_cost": 0.25}
    (folder / "switching.json").write_text(json.dumps(found))
    model = ErrorModel.load(study.model_path)

    def said(adapts=False, bank_adapts=False, study=study):
        settings = model.bank_settings.model_copy(update={"adapt": bank_adapts})
        paired = model.paired.model_copy(update={"adapt": adapts})
        made = replace(model, paired=paired, bank_settings=settings)
        monkeypatch.setattr(ErrorModel, "load", lambda _: made)
        return switch_cost.switch_cost_in_words(study)

    assert said().startswith(
        f"`online` will drive the fixed set (trial {model.fixed}) as `adaptive`"
    )
    assert said().endswith("That has no switch cost.")
    members = ", ".join(map(str, model.bank))
    bank = said(bank_adapts=True)
    assert bank.startswith(f"`online` will drive the bank of trials {members} as `adaptive`")
    assert bank.endswith("no switch cost.")
    alone = said(adapts=True)
    assert alone.startswith("`online` will drive one set at a time as `adaptive`, changed live")
    assert alone.endswith(". Then a switch costs 25.0% of the RTE.")
    handed = load_study(study_file, ["online.switching.mechanism=hand_over"], folder)
    assert said(study=handed).endswith(
        "It never switches; `paper` does, and then a switch costs 0.0% of the RTE."
    )
    only = load_study(study_file, ["online.rules=[paper]"], folder)
    assert said(study=only).startswith(
        "`online` will drive `paper`, and not `adaptive` (online.rules)."
    )
    study.model_path.unlink()
    assert "If `online` will drive one set at a time, a switch costs 25.0%" in said()


def test_a_sequence_can_be_too_short(study_file, tmp_path):
    study = load_study(study_file, folder=tmp_path)
    with pytest.raises(AdaptuneError, match=r"one, none: holds no sub-trajectory of 3 m"):
        switch_cost.measure_switching(study, 0.5)
    assert not (tmp_path / "switching.json").exists()
