import errno
import sys
from pathlib import Path

import pytest
from needs import needs_evalio
from setups import failure

from adaptune.errors import AdaptuneError, import_extra
from offline.config import load_study

STIFF = ["odometry.name=mad_icp", "odometry.parameters=", "odometry.settings={}"]


def test_switching_that_the_odometry_has_not(study_file):
    needs_evalio()
    live = "online.switching.mechanism=live"
    assert load_study(study_file, [live]).mechanism == "live"
    text = failure(study_file, *STIFF, live)
    assert "mad_icp cannot change parameters between scans" in text


def test_switching_is_chosen_by_what_there_is(study_file, monkeypatch):
    needs_evalio()
    for cores, own, mechanism in ((1, "live", None), (2, "bank", "bank")):
        monkeypatch.setattr("adaptune.study.study.available", lambda cores=cores: cores)
        assert load_study(study_file).mechanism == own
        assert load_study(study_file, STIFF).mechanism == mechanism


def test_a_bank_has_a_budget(study_file, monkeypatch):
    needs_evalio()
    monkeypatch.setattr("adaptune.study.study.available", lambda: 4)
    for given, mechanism in (
        ("online.switching.size=4", "bank"),
        ("online.switching.size=5", None),
        ("isolation.memory=5", None),
    ):
        assert load_study(study_file, [*STIFF, given]).mechanism == mechanism


def test_a_budget_is_in_milliseconds_or_in_times_of_the_baseline(study_file):
    budgets = (load_study(study_file, [f"online.budget={b}"]).config.online for b in ("3x", "3.0x"))
    assert len({one.budget for one in budgets}) == 1
    for given, milliseconds in (("15", 15.0), ("3x", 24.0), ("0.5x", 4.0), ("", None)):
        online = load_study(study_file, [f"online.budget={given}"]).config.online
        assert online.milliseconds(8.0) == milliseconds
    for wrong in ("0", "-3x", "x", "much", "true", "nanx"):
        text = failure(study_file, f"online.budget={wrong}")
        assert "online.budget" in text
        assert "give milliseconds of CPU time a scan, or times the baseline's, as 3x" in text


def test_a_folder_that_may_only_be_read_is_named(study_file, tmp_path, monkeypatch):
    study, opened = load_study(study_file, folder=tmp_path / "ro"), Path.open

    def barred(path, mode="r", **how):
        if path.name == ".lock":
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return opened(path, mode, **how)

    monkeypatch.setattr(Path, "open", barred)
    with pytest.raises(
        AdaptuneError, match=r"ro: cannot be written to \(Permission denied\); name"
    ):
        study.open()


def test_an_odometry_that_needs_an_imu(study_file):
    needy = ["odometry.name=faulty:Inertial", "odometry.parameters=", "odometry.settings={}"]
    text = failure(study_file, *needy, "courses.sim={scenes: [garden]}")
    assert "sequences.one: faulty:Inertial needs an IMU; name its topic" in text
    assert "courses.sim: faulty:Inertial needs an IMU; simulate one, imu: 200" in text


def test_overrides_reach_names_with_dots(study_file, tmp_path):
    text = study_file.read_text().replace("bag: ", f"bag: {study_file.parent}/")
    (tmp_path / "s.yaml").write_text(text.replace("one:", "town.v2:").replace("[one", "[town.v2"))
    given = ["sequences.town.v2.stop=2", "sequences.town.v2.extrinsic=[1, 0, 0, 0, 0, 0, 1]"]
    config = load_study(tmp_path / "s.yaml", given, tmp_path / "run").config.sequences["town.v2"]
    assert (config.stop, config.extrinsic[0]) == (2.0, 1.0)


def test_reads_a_study(study_file):
    study = load_study(study_file, ["odometry.name=gicp", "offline.trials=7"])
    assert study.folder == Path("runs/small")
    assert study.config.offline.trials == 7
    assert study.config.sequences["one"].bag == str(study_file.parent / "one.bag")
    assert study.odometry.space.names == ("max_correspondence_distance", "keyframe_interval")
    assert study.odometry.space.parameters["keyframe_interval"].low == 0.5
    assert study.odometry().odometry.settings.downsampling == 0.5
    assert study.odometry({"keyframe_interval": 2.0}).odometry.parameters == {
        "max_correspondence_distance": 2.0,
        "keyframe_interval": 2.0,
        "downsampling": 0.5,
        "iterations": 20,
    }


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("odometry.name=gicpp", ["odometry.name", "did you mean 'gicp'"]),
        ("odometry.settings.downsample=1", ["odometry.settings.downsample", "'downsampling'"]),
        ("odometry.parameters.keyframe={low: 1}", ["did you mean 'keyframe_interval'?"]),
        (
            "odometry.parameters.keyframe_interval={low: 3, high: 2}",
            ["odometry.parameters.keyframe_interval", "low (3) must be less than high (2)"],
        ),
        ("offline.sampler=math:sin", ["offline.sampler", "not a class derived from optuna"]),
        ("offline.sampler=no.such:Best", ["cannot import no.such", "PYTHONPATH"]),
        ("offline.sampler_settings.seed=1", ["sampler_settings.seed", "offline.seed"]),
        (
            "offline={sampler: grid, sampler_settings: {grid: "
            "{max_correspondence_distance: [1, 5, 0], keyframe_interval: [1, 0, 3]}}}",
            ["grid.max_correspondence_distance", "grid.keyframe_interval"],
        ),
        ("offline.trial=3", ["offline.trial", "did you mean 'trials'?"]),
        ("online.switching.mechanism=hand_over", ["give 'auto', 'live' or 'bank', not"]),
        ("test=[three, three]", ["test.1", "named twice"]),
        ("sequences.one.bag=four.bag", ["sequences.one", "four.bag", "no such bag"]),
        ("sequences.one.bag=${NO_SUCH_VARIABLE}/a.bag", ["NO_SUCH_VARIABLE"]),
        ("sequences.one.points=/point", ["sequences.one", "'/points'", "/truth"]),
        ("sequences.one.reference=/points", ["sequences.one", "/points is", "PointCloud2"]),
        ("sequences.one.start=5", ["sequences.one", "start = 5 s is beyond its end"]),
        ("courses.one={scenes: [cave], seed: 1}", ["courses.one", "same name"]),
        ("nonsense", ["-o nonsense"]),
    ],
)
def test_names_each_mistake(study_file, override, words):
    message = failure(study_file, override)
    assert message.startswith("-o")
    for word in words:
        assert word in message


ANNEALING = "offline: {sampler: annealing, sampler_settings: {"
GRID = "offline: {trials: null, sampler: grid, sampler_settings: {grid: {"
MAX_DISTANCE = "max_correspondence_distance: "


@pytest.mark.parametrize(
    ("offline", "line", "words"),
    [
        (ANNEALING + "steps:\n  {keyframe: {mu: 1}}}}", 15, "did you mean 'keyframe_interval'?"),
        (ANNEALING + "steps: {keyframe_interval: {\n delta_max: 3}}}}", 15, "of a log float are"),
        (ANNEALING + "steps: {\n keyframe_interval: {low: 9, high: 8}}}}", 15, "low below high"),
        (
            GRID + "\n keyframe_interval: [1, 1, 3]}}}",
            14,
            "max_correspondence_distance: is missing",
        ),
        (GRID + MAX_DISTANCE + "[1, 1, 3],\n keyframe_interval: [1, 0, 3]}}}", 15, "a step of 0"),
    ],
)
def test_names_mistakes_in_sampler_settings_with_their_lines(study_file, offline, line, words):
    file = study_file.with_name("sampler.yaml")
    lines = study_file.read_text().splitlines()
    file.write_text("\n".join([*lines[:-1], offline, ""]))
    message = failure(file)
    assert f"line {line}: offline.sampler_settings" in message
    assert words in message
    assert len(message.splitlines()) == 1


def test_a_folder_that_cannot_be_made(study_file, tmp_path):
    (tmp_path / "file").write_text("")
    study = load_study(study_file, [], tmp_path / "file/x")
    with pytest.raises(AdaptuneError, match=r"file/x: cannot be written to \(.*--folder"):
        study.open()


def test_folder_goes_on_only_with_the_same_study(study_file, tmp_path):
    folder = tmp_path / "run"
    load_study(study_file, [], folder).open()
    load_study(study_file, ["offline.trials=99", "test=[]", "online.period=2"], folder).open()
    assert "trials: 99" in (folder / "study.yaml").read_text()


def test_a_parameter_that_a_setting_fixes_is_not_tuned(study_file):
    fixed = "odometry.parameters.downsampling={baseline: 0.5}"
    text = failure(study_file, "odometry.name=gicp", fixed)
    assert (
        "odometry.parameters.downsampling: downsampling is fixed by settings; leave it out" in text
    )


@pytest.mark.parametrize(
    ("name", "extra"), [("genz_icp", "evalio"), ("ndt", "open3d"), ("rko_lio", "rko-lio")]
)
def test_an_odometry_that_is_not_installed_is_named(study_file, monkeypatch, name, extra):
    for module in ("evalio", "evalio.pipelines", "open3d", "rko_lio", "rko_lio.rko_lio_pybind"):
        monkeypatch.setitem(sys.modules, module, None)
    import_extra.cache_clear()
    file = study_file.with_name("lacking.yaml")
    text = study_file.read_text()
    one = text[: text.index("sequences:")]
    lines = f"odometry:\n  - name: gicp\n  - settings: {{min_range: 0.5}}\n    name: {name}\n"
    file.write_text(text.replace(one, lines))
    told = failure(file)
    import_extra.cache_clear()
    assert told.startswith(f"{file}, line 4: odometry.1.name: {extra} cannot be imported (")
    assert told.endswith(f"run `pip install 'adaptune[{extra}]'`")
