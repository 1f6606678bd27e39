import re
import shutil
import sys

import drives
import fuzz
import pytest
import yaml
from needs import needs_evalio

from adaptune.errors import import_extra
from adaptune.odometry.registry import OdometryPool
from adaptune.space import ODOMETRY
from adaptune.strict import ConfigurationError
from adaptune.study.config import complete
from adaptune.study.loading import DELETED
from offline.config import OfflineStudyConfig, load_study

STIFF = ["odometry.name=mad_icp", "odometry.parameters=", "odometry.settings={}"]


def failure(file, *overrides):
    with pytest.raises(ConfigurationError) as caught:
        load_study(file, overrides)
    return str(caught.value)


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
        (
            GRID.replace("{grid", "{\n grid") + MAX_DISTANCE + "[1, 0.0001, 31623],"
            " keyframe_interval: {low: 1, high: 9, count: 31623}}}}",
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


def test_names_what_to_install(study_file, monkeypatch):
    monkeypatch.setattr("offline.config.find_spec", lambda _: None)
    for name, package in (("gp", "torch"), ("cmaes", "cmaes")):
        text = failure(study_file, f"offline.sampler={name}")
        assert f"{name} needs the package {package}: pip install 'adaptune[{name}]'" in text


@pytest.mark.parametrize(("old", "words"), DELETED.items())
def test_an_old_key_or_value_is_told_what_became_of_it(study_file, old, words):
    key, _, value = old.partition("=")
    if not value:
        assert failure(study_file, f"{old}=3") == f"-o: {old}: {words}"
        return
    given = f"{key}=[{value}]" if key == "online.modes" else old
    assert f": {value} {words}" in failure(study_file, given)


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


def test_a_parameter_that_a_setting_fixes_is_not_tuned(gicp_study_file):
    text = failure(gicp_study_file, "odometry.parameters.downsampling={baseline: 0.5}")
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


FOREIGN = re.compile(r"pydantic|https://|Input should|validation|Value error|tuple|dict|None")
"""Words of pydantic's and of Python's."""


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("sub_trajectory=true", "sub_trajectory: give a number, not true"),
        ("sub_trajectory=", "sub_trajectory: give a number, not nothing"),
        ("sub_trajectory={a: 1}", "sub_trajectory: give a number, not keys with values"),
        (
            "odometry.settings.iterations=100000000000",
            "odometry.settings.iterations: give a number of at most 10,000, not 100000000000",
        ),
        ("odometry.parameters.keyframe_interval={type: [1]}", "keyframe_interval: give its type"),
        ("odometry.settings=3", "odometry.settings: give keys with values, not 3"),
        ("odometry={settings: {}}", "odometry.name: this key is missing"),
        ("sequences.o@ne={bag: one.bag}", "sequences.o@ne: becomes the name of a file: give"),
        ("sequences.one.bag=~nobodyx/a.bag", "sequences.one.bag: ~nobodyx/a.bag: there is no such"),
        ("sequences.one.bag=''", "sequences.one.bag: give a path, not an empty text"),
        (
            "sequences.one.reference=" + "a" * 300 + ".tum",
            "sequences.one.reference: cannot be reached (File name too long)",
        ),
        ("sequences.one.clock_offset=1e300", "clock_offset: give a number of at most 3e+09, not"),
        ("sequences.one.cache=maybe", "sequences.one.cache: give true or false, not 'maybe'"),
        (
            "sequences.one.views=[" + "{reverse: true}," * 2000 + "]",
            "sequences.one.views: give at most 16, not 2,000",
        ),
        ("sequences.one.views=[{reverse: 3}]", "views.0.reverse: give true, not 3"),
        ("sequences.one.extrinsic=abc", "sequences.one.extrinsic: give numbers: x y z qx qy qz"),
        (
            "sequences.one.extrinsic=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 2, 3, 1]]",
            "sequences.one.extrinsic: its last row is not 0 0 0 1; is it transposed?",
        ),
        (
            "courses.x={scenes: [{scene: cave, lenght: 3}]}",
            "courses.x.scenes.0.lenght: unknown key; did you mean 'length'?",
        ),
        ("training=[]", "training: give at least one, not none"),
        ("health.max_speed=.nan", "health.max_speed: give a finite number, not NaN"),
        ("health.max_speed=1" + "0" * 400, "health.max_speed: give a number of at most 1"),
        ("descriptor.window=3", "window is gone, they are averaged over 3 s"),
        ("online.modes=[paired]", "online.modes.0: paired is now called adaptive"),
        (
            "online.switching.sets=[true, 3]",
            "online.switching.sets.0: give a whole number or keys with values, not true",
        ),
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
            "{max_correspondence_distance: [1, 5, 0], keyframe_interval: [1, 1, 3]}}}",
            "grid.max_correspondence_distance: count, the last number, must be a whole one from 1",
        ),
        (
            "offline={sampler: annealing, objective: [rte, rpe]}",
            ["annealing minimises one objective"],
        ),
        ("offline.objective=[rte, {rte: 1.0}]", ["offline.objective: names an objective twice"]),
        ("offline.trial=3", ["offline.trial", "did you mean 'trials'?"]),
        ("online.switching.mechanism=hand_over", ["hand_over is gone", "give auto, live or bank"]),
        (
            "online.switching.sets=[0, {keyframe_intervall: 1.0}]",
            ["online.switching.sets.1", "did you mean 'keyframe_interval'?"],
        ),
        ("test=[three, three]", ["test.1", "named twice"]),
        ("sequences.one.bag=four.bag", ["sequences.one", "four.bag", "no such bag"]),
        ("sequences.one.bag=${NO_SUCH_VARIABLE}/a.bag", ["NO_SUCH_VARIABLE"]),
        ("sequences.one.points=/point", ["sequences.one", "'/points'", "/truth"]),
        ("sequences.one.reference=/points", ["sequences.one", "/points is", "PointCloud2"]),
        ("sequences.one.start=5", ["sequences.one", "start = 5 s is beyond its end"]),
        ("courses.one={scenes: [cave], seed: 1}", ["courses.one", "same name"]),
        ("nonsense", ["-o nonsense"]),
        ("offline.objective={rte: -1}", ["offline.objective"]),
        ("offline.objective=[]", ["offline.objective"]),
        ("offline.limits={speed: {max: 1}}", ["offline.limits.speed"]),
        ("offline.seed=1e400", "offline.seed: give a finite number, not Infinity"),
        ("offline.limits={rtf: {max: 3}}", "offline.limits.rtf: give 'rte', 'kitti', 'rpe', 'ape'"),
        (
            "offline={sampler: grid, sampler_settings: {grid: {keyframe_interval: 3}}}",
            "offline.sampler_settings.grid.keyframe_interval: give keys with values or a list, not",
        ),
    ],
)
def test_a_mistake_is_told_once_in_plain_words(study_file, override, words):
    told = failure(study_file, override)
    assert told.startswith("-o")
    for word in [words] if isinstance(words, str) else words:
        assert word in told
    assert len(told.splitlines()) == 1
    # The words of the test itself are quoted, not said.
    assert not FOREIGN.search(told)
    assert len(told) < 250


def test_all_mistakes_are_told_together(study_file):
    file = study_file.with_name("all.yaml")
    file.write_text(
        study_file.read_text()
        .replace("downsampling: 0.5", "downsampling: true")
        .replace("bag: one.bag", "bag: one.bag, stride: 0")
        .replace("points: /points, reference: /truth}\n  three", "points: /p}\n  three")
        .replace("test: [three]", "test: [threee]")
        .replace("sub_trajectory: 3.0", "sub_trajectory: abc")
        .replace("trials: 10", "trials: 0, sampler_settings: {gama: 1}")
        + "online: {switching: {mechanism: lively, sets: [0]}}\n"
    )
    lines = failure(file).splitlines()
    assert [re.sub(r".*, line (\d+): ([\w.]+): .*", r"\1 \2", line) for line in lines] == [
        "3 odometry.settings.downsampling",
        "8 sequences.one.stride",
        "9 sequences.two",
        "12 test.0",
        "13 sub_trajectory",
        "14 offline.trials",
        "14 offline.sampler_settings.gama",
        "15 online.switching.mechanism",
        "15 online.switching.sets",
    ]


def test_what_needs_the_odometry_is_told_beside_other_mistakes(study_file):
    steps = "sampler_settings: {steps: {keyframe: {mu: 1}}}"
    offline = f"offline={{sampler: annealing, trials: 0, {steps}}}"
    told = failure(study_file, offline, "sequences.one.stride=0", "online.period=abc")
    assert "offline.sampler_settings.steps.keyframe: no parameter 'keyframe' is tuned" in told
    assert len(told.splitlines()) == 4


@pytest.mark.parametrize("given", ["abc", "-1", "nan", "inf", "1e400"])
def test_a_wrong_size_of_the_cache_is_told_once(study_file, monkeypatch, given):
    monkeypatch.setenv("ADAPTUNE_CACHE_GB", given)
    with pytest.raises(Exception, match=r"^ADAPTUNE_CACHE_GB is .*; give gigabytes, 0 or more"):
        load_study(study_file)


@pytest.mark.parametrize("kind", ["folder", "device", "large"])
def test_what_cannot_be_a_study_is_not_read(tmp_path, kind):
    path = tmp_path / "study.yaml"
    if kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        path.write_text("a: b\n" * 300_000)
    assert failure(path) == f"{path}: a study is a file of YAML, of 1 MB at most"


def test_damaged_studies_give_a_study_or_an_error(tmp_path):
    counts = fuzz.fuzz_studies(100, 1, tmp_path)
    assert min(counts["errors"], counts["studies"]) > 0


COURSES = "courses.cave={scenes: [cave], length: 10, seed: 1}"


def written(study_file, name, **changes):
    """The study with other values, in a file of its own beside its bags."""
    study = yaml.safe_load(study_file.read_text()) | changes
    file = study_file.with_name(f"{name}.yaml")
    file.write_text(yaml.safe_dump(study, sort_keys=False))
    return file


def test_parts_become_sequences_of_their_own(study_file, tmp_path):
    overrides = ["training=[one: 0-60%, two]", "test=[one: 60-100%]"]
    study = load_study(study_file, overrides, tmp_path)
    assert study.training == ["one_0-60", "two"]
    assert study.config.test == ("one_60-100",)
    assert study.config.sequences["one_0-60"].part == (0.0, 0.6)
    first, second = (
        [scan.stamp for scan in study.sequences.open(name)] for name in ("one_0-60", "one_60-100")
    )
    assert first + second == [scan.stamp for scan in study.sequences.open("one")]
    assert len(first) == pytest.approx(24, abs=1)
    recorded_in = study.sequences.recorded_in
    assert recorded_in("one_0-60") == recorded_in("one_60-100") == recorded_in("one")
    assert recorded_in("one") != recorded_in("two")


def test_parts_of_a_course_share_its_recording(study_file, tmp_path):
    overrides = [COURSES, "training=[cave: 0-50%]", "test=[cave: 50-100%]"]
    sequences = load_study(study_file, overrides, tmp_path).sequences
    assert sequences.recording("cave_0-50") == sequences.recording("cave")
    assert sequences.recorded_in("cave_0-50") == sequences.recorded_in("cave")
    assert sequences.config("cave_0-50").part == (0.0, 0.5)
    with pytest.raises(ConfigurationError, match="adaptune simulate"):
        sequences.open("cave_0-50")


@pytest.mark.parametrize(
    ("roles", "key", "words"),
    [
        ({"training": [{"one": "60-0%"}]}, "training.0", "60-0% of one is no part"),
        ({"training": [{"one": "0-60%", "two": "0-60%"}]}, "training.0", "an entry of its own"),
        ({"training": [{"one": "0-60%"}] * 2}, "training.1", "named twice"),
        (
            {"training": [{"one": "0-60%"}, {"one": "50-100%"}]},
            "training.1",
            "overlaps one_0-60; name parts that share no scan",
        ),
        ({"training": ["one"], "test": ["one"]}, "test.0", "[one: 0-60%], test: [one: 60-100%]"),
        (
            {"training": [{"one": "0-60%"}], "test": [{"one": "50-100%"}]},
            "test.0",
            "overlaps one_0-60",
        ),
    ],
)
def test_mistakes_in_roles_are_told_once_with_their_line(study_file, roles, key, words):
    text = failure(written(study_file, "roles", **roles))
    assert words in text
    assert f": {key}: " in text
    assert "line" in text
    assert len(text.splitlines()) == 1


def test_a_name_that_is_taken(study_file):
    taken = "sequences.one_0-60={bag: two.bag, points: /points, reference: /truth}"
    text = failure(study_file, taken, "training=[one: 0-60%]")
    assert "training.0: there is another sequence one_0-60" in text


@pytest.fixture
def load(study_file, tmp_path):
    """Load a study whose test sequence is a copy of a training sequence's bag."""
    shutil.copytree(study_file.parent, tmp_path, dirs_exist_ok=True)
    shutil.copyfile(tmp_path / "one.bag", tmp_path / "copy.bag")

    def make(*overrides):
        given = ["sequences.three.bag=copy.bag", *overrides]
        return load_study(tmp_path / "small.yaml", given, tmp_path / "run")

    return make


def test_a_copy_of_a_training_sequence_is_refused(load):
    with pytest.raises(ConfigurationError, match=r"line 12: test\.0: 'three' is the recording of"):
        load()


@pytest.mark.parametrize(
    ("one", "three", "overlapping"),
    [("stop=2", "start=2", False), ("stop=2", "start=1.9", True), ("start=1", "stride=2", True)],
)
def test_sections_may_not_overlap(load, one, three, overlapping):
    overrides = [f"sequences.one.{one}", f"sequences.three.{three}"]
    if not overlapping:
        load(*overrides)
        return
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*overrides)


def test_a_copy_of_a_folder_is_refused(load, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        for i in range(3):
            (tmp_path / name / f"{i}.bin").write_bytes(bytes([i + 1]) * 16 * (i + 1))
        (tmp_path / name / "times.txt").write_text("0\n1\n2\n")
    poses = (tmp_path / "poses.tum").absolute()
    poses.write_text("0 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    given = [
        f"sequences.{name}={{folder: {folder}, reference: {poses}}}"
        for name, folder in (("one", "a"), ("three", "b"))
    ]
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*given)
    for i in range(3):
        (tmp_path / "b" / f"{i}.bin").write_bytes(bytes([i + 7]) * 16 * (i + 1))
    load(*given)


def test_two_names_of_one_course(load):
    course = "{scenes: [cave], seed: 1}"
    names = ["courses.a=" + course, "courses.b=" + course, "training=[one, a]", "test=[b]"]
    with pytest.raises(ConfigurationError, match="'b' is the recording of the training"):
        load(*names)
    load(*names, "courses.b.seed=2")


def test_sections_of_several_bags_are_compared_by_their_stamps(load, tmp_path):
    earlier = [(stamp - 10 * 10**9, *rest) for stamp, *rest in drives.scans(9, 40)]
    drives.write_bag(tmp_path / "earlier.bag", earlier)
    both = ["sequences.one.bag=[earlier.bag, one.bag]", "sequences.one.start=11"]
    with pytest.raises(ConfigurationError, match="proves nothing here"):
        load(*both, "sequences.three.stop=2")
    load(*both, "sequences.three.stop=1")


TWO = """
  - gicp
  - name: vgicp
    parameters: {resolution: {low: 1.0}}
"""


@pytest.fixture
def study_of(study_file, tmp_path):
    """Load the study with other odometries, which are given as YAML."""

    def load(odometry, *overrides):
        path = tmp_path / "several.yaml"
        path.write_text(drives.study_with(f"odometry:{odometry}\n", study_file.parent))
        return load_study(path, list(overrides), runs=tmp_path)

    return load


def refused(study_of, odometry, *overrides):
    with pytest.raises(ConfigurationError) as caught:
        study_of(odometry, *overrides)
    return str(caught.value)


def test_a_study_of_two(study_of):
    study = study_of(TWO)
    pool = study.odometry
    assert isinstance(pool, OdometryPool)
    assert pool.name == "gicp, vgicp"
    assert pool.space.baseline[ODOMETRY] == "gicp"
    assert pool.space.spaces["vgicp"].parameters["resolution"].low == 1.0
    assert not pool.description.live
    assert pool.identity["settings"]["vgicp"]["name"] == "vgicp"
    assert study.mechanism in ("bank", None)


@pytest.mark.parametrize(
    ("odometry", "said"),
    [
        (
            "\n  - gicp\n  - {name: gicp, label: again}",
            "odometry.1: gicp is there already (odometry.0) with the same settings",
        ),
        (
            "\n  - gicp\n  - {name: gicp, settings: {downsampling: 1.0}}",
            "odometry.1.label: 'gicp' is what odometry.0 is called",
        ),
        (
            "\n  - gicp\n  - {name: command, parameters: {x: {type: float, low: 0, high: 1, "
            "baseline: 0}}, settings: {command: [cat, '{input}', '{output}', '{x}']}}",
            "odometry.1.name: command runs whole recordings, and must be the only one",
        ),
    ],
)
def test_lists_that_are_refused(study_of, odometry, said):
    assert said in refused(study_of, odometry)


def test_mistakes_have_the_line_of_their_odometry(study_of):
    text = refused(study_of, "\n  - gicp\n  - vgicp\n  - {name: ndt, settings: {iteration: 3}}")
    assert "line 4: odometry.2.settings.iteration: unknown key" in text


def test_sets_of_a_bank_say_which_odometry_they_are_for(study_of):
    sets = "online.switching.sets=[{resolution: 2.0}, {odometry: gicp}]"
    text = refused(study_of, TWO, sets)
    assert "online.switching.sets.0: odometry: names no odometry; there is 'gicp', 'vgicp'" in text


def test_none_of_several_is_changed_live(study_of):
    text = refused(study_of, TWO, "online.switching.mechanism=live")
    assert "gicp, vgicp cannot change parameters between scans" in text


@pytest.mark.parametrize(
    ("incomplete", "completed"),
    [
        ("offline.tr", ["offline.trials="]),
        ("offline.sets=", ["offline.sets=shared", "offline.sets=own"]),
        ("offline.sampler=gr", ["offline.sampler=grid"]),
    ],
)
def test_keys_and_values_are_completed(incomplete, completed):
    assert complete(OfflineStudyConfig, incomplete, {"offline.sampler": ["tpe", "grid"]}) == (
        completed
    )


MOST_KEYS = 45
"""Outside of odometries, sequences and courses."""


def test_there_are_no_more_keys_than_a_reader_can_take_in():
    names = [key.rstrip("=") for key in complete(OfflineStudyConfig, "")]
    shared = [n for n in names if n.split(".")[0] not in ("odometry", "sequences", "courses")]
    assert len(shared) <= MOST_KEYS, shared
