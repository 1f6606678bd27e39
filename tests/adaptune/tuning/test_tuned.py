"""`adaptune.tune`: what `tune` does, as a function."""

import logging
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import drives
import fake_odometry
import numpy as np
import pytest
import yaml

import adaptune
from adaptune._system.progress import bars_and_words
from adaptune.errors import AdaptuneError, OdometryError
from adaptune.odometry.keyframe import KeyframeGicp
from adaptune.tuning.asked import Asked, named_odometry
from adaptune.tuning.tuned import OutOfTimeError, within


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_an_odometry_is_a_name_a_class_or_an_object(monkeypatch, tmp_path):
    assert named_odometry("mine:Icp") == ("mine:Icp", {})
    assert named_odometry(KeyframeGicp) == ("gicp", {})
    several = ["kiss_icp", KeyframeGicp, fake_odometry.Fake(keyframe_interval=3.0)]
    names, about = named_odometry(several)
    assert names == f"kiss_icp,gicp,{fake_odometry.NAME}"
    (own,) = (about.pop(fake_odometry.NAME), *about)
    assert own["settings"] == {}
    assert own["parameters"]["keyframe_interval"] == {"baseline": 3.0}
    with pytest.raises(OdometryError, match="has no parameter 'keyframe_intervall': did you mean"):
        fake_odometry.Fake(keyframe_intervall=3.0)

    # A script's own class is imported by the script's name; a session has none.
    class Own(fake_odometry.Fake):
        __module__ = "__main__"

    Own.__qualname__ = "Own"
    script = tmp_path / "my_script.py"
    script.touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script), raising=False)
    assert named_odometry(Own) == ("my_script:Own", {})
    monkeypatch.delattr(sys.modules["__main__"], "__file__")
    assert named_odometry(Own) == ("__main__:Own", {})


def test_a_class_of_a_session_is_refused_in_a_sentence():
    drives.write_bag(Path("one.bag"), drives.scans(n_scans=60))
    with pytest.raises(AdaptuneError, match="Own lives in this session only; put it into a file"):
        adaptune.tune("one.bag", odometry="__main__:Own")


def test_a_script_without_a_guard_is_told_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drives.write_bag(tmp_path / "one.bag", drives.scans(n_scans=20))
    code = (
        "import adaptune\nfrom adaptune.odometry import Odometry\n\n\n"
        "class Own(Odometry):\n    live, space = False, {}\n\n\n"
        "adaptune.tune('one.bag', odometry=Own)\n"
    )
    (tmp_path / "unguarded.py").write_text(code)
    command = [sys.executable, "unguarded.py"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1]
    assert 'call adaptune.tune below `if __name__ == "__main__":`' in last


def test_a_session_without_logging_sees_what_is_logged(capsys, monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    log = logging.getLogger("offline.train")
    with bars_and_words() as show:
        show("runs", 1, 2)
        log.info("it takes about 3 min [all]")
    log.info("later")
    said = capsys.readouterr().err
    assert "it takes about 3 min [all]" in said
    assert "later" not in said


def test_a_notebook_stores_no_bars(capsys, monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    monkeypatch.setenv("FORCE_COLOR", "1")  # as the kernel does
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with bars_and_words() as show:
        for i in range(9):
            now[0] = 1.5 * i
            show(f"brief {i}", 1, 2)
            show("runs", i, 9)
        logging.getLogger("offline.train").info("done")
    said = capsys.readouterr().err
    assert "\x1b" not in said
    assert (said.count("runs:"), said.count("brief"), said.count("done")) == (2, 0, 1)


def test_numbers_may_be_those_of_numpy():
    about = {"parameters": {"n": {"baseline": np.int64(3)}}}
    asked = Asked([Path("a.bag")], about=about, budget=np.float64(5.0))
    assert yaml.safe_dump(asked.limits) == "online.budget: 5.0\n"
    assert asked.inputs["the odometry's object"] == {"parameters": {"n": {"baseline": 3}}}


@pytest.mark.parametrize("given", [lambda: None, ["gicp", 3], [], None])
def test_what_is_no_odometry_is_refused(given):
    with pytest.raises(AdaptuneError, match="odometry: give a name, or several with commas"):
        named_odometry(given)


def test_a_misspelt_reading_is_refused(monkeypatch):
    with pytest.raises(AdaptuneError, match="reading: give 'one' or 'several', not 'severl'"):
        adaptune.tune("one.bag", reading="severl")
    given = []
    monkeypatch.setattr("adaptune.tuning.tuned.tune_asked", lambda *args: given.append(args[1]))
    adaptune.tune("one.bag", overrides="offline.seed=1")
    assert given == [["offline.seed=1"]]


def test_no_recording_is_refused():
    with pytest.raises(AdaptuneError, match="name a recording"):
        adaptune.tune([])


def test_results_stay_where_they_are_if_the_working_folder_changes(monkeypatch, tmp_path):
    given = []
    monkeypatch.setattr("adaptune.tuning.tuned.tune_asked", lambda *args: given.append(args[2]))
    adaptune.tune("some/one.bag", "kiss_icp")
    adaptune.tune(["one.bag", "two.bag"], folder="mine")
    assert given == [tmp_path / "runs/one_kiss_icp", tmp_path / "mine"]


def test_banks_that_do_not_fit_into_the_time_are_not_replayed():
    clock, shown = SimpleNamespace(hours=0.1), []
    show = within(0.2, clock, lambda *how: shown.append(how))
    show("hall, adaptive", 1, 20)
    clock.hours = 0.22
    show("hall, adaptive", 20, 20)  # what is done stays
    with pytest.raises(OutOfTimeError, match="hall, adaptive: does not fit into the time"):
        show("hall, adaptive", 2, 20)
    assert [how[1] for how in shown] == [1, 20, 2]


def test_a_study_of_which_nobody_knows_how_it_was_made_is_kept():
    drives.write_bag(Path("one.bag"), drives.scans(n_scans=60))
    path = Path("runs/one/one.yaml")
    path.parent.mkdir(parents=True)
    path.write_text("odometry: gicp\n")
    with pytest.raises(AdaptuneError, match=r"asked\.json beside it is gone, or an older adaptune"):
        adaptune.tune("one.bag")
    assert path.read_text() == "odometry: gicp\n"


def test_the_package_has_these_names():
    assert {"tune", "compare"} < set(dir(adaptune))
    assert all(getattr(adaptune, name) for name in dir(adaptune))
    with pytest.raises(AttributeError, match="has no attribute 'tuna'"):
        _ = adaptune.tuna
