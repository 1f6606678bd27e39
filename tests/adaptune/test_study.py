import sys

import pytest
from needs import needs_evalio

from adaptune.errors import DELETED, RENAMED, import_extra
from adaptune.strict import ConfigurationError
from offline.config import load_study


def failure(file, *overrides):
    with pytest.raises(ConfigurationError) as caught:
        load_study(file, overrides)
    return str(caught.value)


def test_switching_that_the_odometry_has_not(study_file):
    needs_evalio()
    live = "online.switching.mechanism=live"
    assert load_study(study_file, [live]).mechanism == "live"
    stiff = ["odometry.name=mad_icp", "odometry.parameters=", "odometry.settings={}"]
    text = failure(study_file, *stiff, live)
    assert "mad_icp cannot change parameters between scans" in text


def test_switching_is_chosen_by_what_there_is(study_file, monkeypatch):
    needs_evalio()
    stiff = ["odometry.name=mad_icp", "odometry.parameters=", "odometry.settings={}"]
    for cores, own, mechanism in ((1, "live", None), (2, "bank", "bank")):
        monkeypatch.setattr("adaptune.study.study.available", lambda cores=cores: cores)
        assert load_study(study_file).mechanism == own
        assert load_study(study_file, stiff).mechanism == mechanism


def test_a_bank_has_a_budget(study_file, monkeypatch):
    needs_evalio()
    monkeypatch.setattr("adaptune.study.study.available", lambda: 4)
    stiff = ["odometry.name=mad_icp", "odometry.parameters=", "odometry.settings={}"]
    for given, mechanism in (
        ("online.switching.memory=16", "bank"),
        ("online.switching.memory=15", None),
        ("online.switching.cores=1", None),
        ("online.switching.size=5", None),
        ("isolation.memory=5", None),
    ):
        assert load_study(study_file, [*stiff, given]).mechanism == mechanism


def test_an_odometry_that_needs_an_imu(study_file):
    needy = ["odometry.name=inertial:Inertial", "odometry.parameters=", "odometry.settings={}"]
    text = failure(study_file, *needy, "courses.sim={scenes: [garden]}")
    assert "sequences.one: inertial:Inertial needs an IMU; name its topic" in text
    assert "courses.sim: inertial:Inertial needs an IMU; simulate one, imu: 200" in text


def test_reads_a_study(gicp_study_file, tmp_path):
    study = load_study(gicp_study_file, ["offline.trials=7"], runs=tmp_path)
    assert study.folder == tmp_path / "small"
    assert study.config.offline.trials == 7
    assert study.config.sequences["one"].bag == str(gicp_study_file.parent / "one.bag")
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
        ("odometry.settings.downsampling=-1", ["odometry.settings.downsampling", "-1"]),
        ("odometry.parameters.keyframe=1", ["odometry.parameters.keyframe"]),
        ("odometry.parameters.keyframe={low: 1}", ["did you mean 'keyframe_interval'?"]),
        (
            "odometry.parameters.keyframe_interval={low: 3, high: 2}",
            ["odometry.parameters.keyframe_interval", "low (3) must be less than high (2)"],
        ),
        (
            "odometry.parameters.keyframe_interval.baseline=99",
            ["keyframe_interval", "baseline (99)"],
        ),
        (
            "odometry.parameters.keyframe_interval.low=0",
            ["keyframe_interval", "log scale needs low (0) above 0"],
        ),
        ("sub_trajectory=none", ["sub_trajectory: give a number, not 'none'"]),
        ("sub_trajectories=1", ["sub_trajectories: unknown key", "'sub_trajectory'"]),
        ("offline.sampler=tpee", ["offline.sampler", "'tpe'"]),
        ("offline.sampler=math:sin", ["offline.sampler", "not a class derived from optuna"]),
        ("offline.sampler=optuna.samplers:Best", ["optuna.samplers has no Best"]),
        ("offline.sampler=no.such:Best", ["cannot import no.such", "PYTHONPATH"]),
        (
            "offline.sampler_settings.gama=1",
            ["gama: tpe has no such setting; did you mean 'gamma'"],
        ),
        ("offline.sampler_settings.seed=1", ["sampler_settings.seed", "offline.seed"]),
        ("offline.sampler_settings=7", ["offline.sampler_settings"]),
        (
            "offline={sampler: grid, sampler_settings: {grid: "
            "{max_correspondence_distance: [1, 5, 0], keyframe_interval: [1, 0, 3]}}}",
            ["grid.max_correspondence_distance", "grid.keyframe_interval"],
        ),
        (
            "offline={sampler: annealing, objective: [rte, rpe]}",
            ["annealing minimises one objective"],
        ),
        ("offline.objective=rtee", ["offline.objective: there is no metric 'rtee'", "'rte'"]),
        ("offline.objective={rte: 1, appe: 1}", ["there is no metric 'appe'", "'ape'"]),
        ("offline.objective=[rte, {rte: 1.0}]", ["offline.objective: names an objective twice"]),
        ("offline.hours=0", ["offline.hours", "not 0"]),
        ("offline.stagnation=0", ["offline.stagnation", "not 0"]),
        ("offline.trial=3", ["offline.trial", "did you mean 'trials'?"]),
        ("offline.trials=0", ["offline.trials", "not 0"]),
        ("online.rules=[best]", ["online.rules.0", "best"]),
        ("online.switching.mechanism=banks", ["online.switching.mechanism", "banks"]),
        ("online.switching.mechanism=hand_over", ["hand_over is gone", "give auto, live or bank"]),
        ("online.switching.warm_up=0", ["online.switching.warm_up", "not 0"]),
        ("online.switching.size=7", ["online.switching.size", "not 7"]),
        ("online.switching.warmup=5", ["did you mean 'warm_up'?"]),
        ("online.switching.sets=[0]", ["online.switching.sets"]),
        (
            "online.switching.sets=[0, {keyframe_intervall: 1.0}]",
            ["online.switching.sets.1", "did you mean 'keyframe_interval'?"],
        ),
        ("training=[ones]", ["training.0", "did you mean 'one'?"]),
        ("training=[]", ["training"]),
        ("test=[three, three]", ["test.1", "named twice"]),
        ("sequences.one.bag=four.bag", ["sequences.one", "four.bag", "no such bag"]),
        ("sequences.one.bag=${NO_SUCH_VARIABLE}/a.bag", ["NO_SUCH_VARIABLE"]),
        ("sequences.one.bag=7", ["sequences.one.bag: give the path of a bag"]),
        ("sequences.one.bag=['${NO_SUCH_VARIABLE}']", ["sequences.one.bag: the environment"]),
        ("sequences.one.points=/point", ["sequences.one", "'/points'", "/truth"]),
        ("sequences.one.points=/truth", ["sequences.one", "/truth is", "PoseStamped"]),
        ("sequences.one.reference=/points", ["sequences.one", "/points is", "PointCloud2"]),
        ("sequences.one.reference=no.tum", ["sequences.one", "no.tum"]),
        ("sequences.one.stops=1", ["sequences.one.stops", "'stop'"]),
        ("sequences.one.start=1", None),
        ("sequences.one.start=5", ["sequences.one", "start = 5 s is beyond its end"]),
        ("courses.one={scenes: [cave], seed: 1}", ["courses.one", "same name"]),
        ("courses.far={scenes: [caves], seed: 1}", ["courses.far", "cave"]),
        ("nonsense", ["-o nonsense"]),
        ("offline={", ["-o offline={"]),
    ],
)
def test_names_each_mistake(study_file, override, words):
    if words is None:
        load_study(study_file, [override])
        return
    message = failure(study_file, override)
    assert message.startswith("-o")
    for word in words:
        assert word in message


ANNEALING = "offline: {sampler: annealing, sampler_settings: {"
GRID = "offline: {trials: null, sampler: grid, sampler_settings: {grid: {"


@pytest.mark.parametrize(
    ("offline", "line", "words"),
    [
        (ANNEALING + "steps:\n  {keyframe: {mu: 1}}}}", 15, "did you mean 'keyframe_interval'?"),
        (
            ANNEALING + "steps: {keyframe_interval:\n  {sigma: -1}}}}",
            15,
            "sigma: give a number of at least 0, not -1",
        ),
        (
            ANNEALING + "steps: {\n keyframe_interval: {mu: 0, sigma: 0}}}}",
            15,
            "never moves with mu",
        ),
        (ANNEALING + "steps: {\n keyframe_interval: {sigma: 0}}}}", 15, "never moves with sigma 0"),
        (
            ANNEALING + "steps: {keyframe_interval: {\n delta_max: 3}}}}",
            15,
            "delta_max: steps of a log float are set by mu, sigma, low and high",
        ),
        (
            ANNEALING + "steps: {\n keyframe_interval: {low: 0.1}}}}",
            15,
            "the walk's low and high must lie in [0.5, 15], low below high",
        ),
        (
            ANNEALING + "steps: {\n keyframe_interval: {low: 9, high: 8}}}}",
            15,
            "the walk's low and high must lie in [0.5, 15], low below high",
        ),
        (
            ANNEALING + "start: {\n keyframe_interval: 20}}}",
            15,
            "give a number from 0.5 to 15, not 20",
        ),
        (
            ANNEALING + "steps: {keyframe_interval: {high: 8}}, start: {\n keyframe_interval: 9}}}",
            15,
            "give a number from 0.5 to 8, not 9",
        ),
        (
            ANNEALING + "start: {\n keyframe: 9}}}",
            15,
            "no parameter 'keyframe' is tuned: did you mean 'keyframe_interval'?",
        ),
        (ANNEALING + "\n alfa: 0.9}}", 15, "alfa: unknown key; did you mean 'alpha'?"),
        (ANNEALING + "\n alpha: 1.1}}", 15, "not 1.1"),
        (
            GRID + "\n keyframe_interval: [1, 1, 3]}}}",
            14,
            "max_correspondence_distance: is missing",
        ),
        (GRID + "\n keyframe: [1, 1, 3]}}}", 15, "did you mean 'keyframe_interval'?"),
        (
            GRID + "max_correspondence_distance: [1, 1, 3],\n keyframe_interval: [1, 1, 30]}}}",
            15,
            "30 is outside [0.5, 15]",
        ),
        (
            GRID + "max_correspondence_distance: [1, 1, 3],\n keyframe_interval: [1, 0, 3]}}}",
            15,
            "a step of 0",
        ),
        (
            "offline: {sampler: grid, sampler_settings: {\n grid: {max_correspondence_distance:"
            " [1, 0.0001, 31623], keyframe_interval: {low: 1, high: 9, count: 31623}}}}",
            15,
            "has 1,000,014,129 points, and the study sets no budget; give offline.trials, hours or",
        ),
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


def test_a_large_grid_may_be_walked_with_a_budget(study_file):
    load_study(
        study_file,
        [
            "offline.sampler=grid",
            "offline.sampler_settings={grid: {max_correspondence_distance: [1, 0.0001, 30000],"
            " keyframe_interval: {low: 1, high: 9, count: 30000}}}",
            "offline.trials=",
            "offline.hours=1",
        ],
    )


def test_names_what_to_install(study_file, monkeypatch):
    monkeypatch.setattr("offline.config.find_spec", lambda _: None)
    for name, package in (("gp", "torch"), ("cmaes", "cmaes")):
        text = failure(study_file, f"offline.sampler={name}")
        assert f"{name} needs the package {package}: pip install 'adaptune[{name}]'" in text


def test_reports_all_mistakes_at_once_with_their_lines(study_file):
    file = study_file.with_name("wrong.yaml")
    file.write_text(
        study_file.read_text()
        .replace("low: 0.5, high: 15.0", "low: 20, high: 15.0")
        .replace("bag: two.bag", "bag: too.bag")
        .replace("trials: 10", "trails: 10")
        .replace("test: [three]", "test: [threee]")
    )
    lines = failure(file).splitlines()
    assert [line.split(": ")[1] for line in lines] == [
        "odometry.parameters.keyframe_interval",
        "sequences.two",
        "test.0",
        "offline.trails",
    ]
    assert [int(line.split("line ")[1].split(":")[0]) for line in lines] == [6, 9, 12, 14]


@pytest.mark.parametrize(
    ("old", "words"),
    [*((old, f"is now called {new}") for old, new in RENAMED.items()), *DELETED.items()],
)
def test_an_old_key_is_told_what_became_of_it(study_file, old, words):
    assert failure(study_file, f"{old}=3") == f"-o: {old}: {words}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "mapping"),
        ("- a\n", "mapping"),
        ("a: [", "line 1"),
        ("training: [a]\ntraining: [b]\n", "line 2: 'training' was given before, in line 1"),
        ("\x00", "special characters"),
    ],
)
def test_refuses_what_is_no_study(tmp_path, text, words):
    file = tmp_path / "a.yaml"
    file.write_text(text)
    message = failure(file)
    assert str(file) in message
    assert words in message


def test_names_a_missing_file(tmp_path):
    assert "no such file" in failure(tmp_path / "a.yaml")


def test_a_folder_that_cannot_be_made(study_file, tmp_path):
    (tmp_path / "file").write_text("")
    study = load_study(study_file, [], tmp_path / "file/x")
    with pytest.raises(ConfigurationError, match=r"file/x: the study's folder .*--folder"):
        study.open()


def test_folder_goes_on_only_with_the_same_study(study_file, tmp_path):
    folder = tmp_path / "run"
    load_study(study_file, [], folder).open()
    load_study(study_file, ["offline.trials=99", "test=[]", "online.period=2"], folder).open()
    assert "trials: 99" in (folder / "study.yaml").read_text()


def test_an_empty_section_can_be_overridden(study_file):
    file = study_file.with_name("empty.yaml")
    file.write_text(study_file.read_text() + "health:\n")
    assert load_study(file, ["health.max_speed=7"]).config.health.max_speed == 7


def test_a_parameter_that_a_setting_fixes_is_not_tuned(gicp_study_file):
    text = failure(gicp_study_file, "odometry.parameters.downsampling={baseline: 0.5}")
    assert (
        "odometry.parameters.downsampling: downsampling is fixed by settings; leave it out" in text
    )


@pytest.mark.parametrize("name", ["genz_icp", "rko_lio"])
def test_an_odometry_that_is_not_installed_is_named(study_file, monkeypatch, name):
    extra = "evalio" if name == "genz_icp" else name
    for module in ("evalio", "evalio.pipelines", "rko_lio", "rko_lio.rko_lio_pybind"):
        monkeypatch.setitem(sys.modules, module, None)
    import_extra.cache_clear()
    file = study_file.with_name("lacking.yaml")
    text = study_file.read_text()
    one = text[: text.index("sequences:")]
    lines = f"odometry:\n  - name: gicp\n  - settings: {{deskew: false}}\n    name: {name}\n"
    file.write_text(text.replace(one, lines))
    told = failure(file)
    import_extra.cache_clear()
    assert told.startswith(f"{file}, line 4: odometry.1.name: {extra} cannot be imported (")
    assert told.endswith(f"run `pip install 'adaptune[{extra}]'`")


def test_an_odometry_whose_module_cannot_be_imported_is_named(study_file, monkeypatch):
    monkeypatch.delitem(sys.modules, "adaptune.odometry.kiss_icp", raising=False)
    monkeypatch.setitem(sys.modules, "kiss_icp.config", None)
    stiff = ["odometry.name=kiss_icp", "odometry.parameters=", "odometry.settings={}"]
    told = failure(study_file, *stiff)
    assert "odometry.name: kiss_icp: cannot import adaptune.odometry.kiss_icp (import of " in told
    assert "install it" in told
