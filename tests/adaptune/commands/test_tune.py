"""Tuning from recordings alone, with no study file."""

import shutil
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import commands
import drives
import pytest
import rec

from adaptune._system.yaml12 import Document
from adaptune.commands.tune import say_odometries
from adaptune.recording.bag import BagSource
from adaptune.simulation import Course
from adaptune.simulation.record import record
from adaptune.study import loading
from adaptune.study.driven import COST
from adaptune.tuning import EACH, TRIALS, asked, studies, tuned
from offline.config import load_study

FAKE = ("--odometry", "fake_odometry:Fake")


def failed(*arguments):
    return commands.refused("tune", *arguments)


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def study_in(file):
    """The study that was written to a file."""
    return load_study(Path(file), [], Path("elsewhere"))


@pytest.fixture
def bag(study_file, tmp_path):
    (tmp_path / "one.bag").symlink_to(study_file.parent / "one.bag")
    return tmp_path / "one.bag"


@pytest.fixture
def decided(monkeypatch):
    """Only decide; nothing is run. The studies that were decided."""

    write_study, studies = tuned.write_study, []

    def stop(*given):
        study, _ = write_study(*given)
        studies.append(study)
        raise tuned.AdaptuneError(str(study.folder / f"{study.name}.yaml"))

    monkeypatch.setattr(tuned, "write_study", stop)
    return studies


@pytest.mark.services
def test_one_command_tunes_compares_and_resumes(bag, tmp_path):
    done = commands.succeeded("tune", bag, *FAKE, "--trials", 4)
    folder = tmp_path / "runs/one_fake_odometry_Fake"
    lines = done.stdout.splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith(("Drive", "Keep")))
    assert (folder / "report/report.html").exists()
    assert lines[begin + 1].startswith("What each choice gives over ")
    assert f"Files: runs/{folder.name}." in " ".join(done.stdout.split())
    assert (folder / "verdict.json").exists()
    (more,) = (line for line in lines if line.startswith("More: "))
    assert more.startswith("More: runs/")
    # The same command does nothing again; a greater budget continues.
    model = (folder / "model.safetensors").stat().st_mtime_ns
    commands.call("tune", bag, *FAKE, "--trials", 4)
    assert (folder / "model.safetensors").stat().st_mtime_ns == model
    done = commands.call("tune", bag, *FAKE, "--trials", 6)
    assert len((folder / "trials.csv").read_text().splitlines()) == 7, done.output
    assert "The fixed set is trial " in commands.call("trials", folder).stdout
    # Other commands take the file that it wrote.
    commands.succeeded("compare", folder / f"{folder.name}.yaml")


@pytest.mark.usefixtures("decided")
@pytest.mark.parametrize(
    "name",
    [
        *("20240501", "001", "1e3", "1.5", "true", "null", "~", "a: b #c", "a\nb: c", "'", "x[1]"),
        *("a$HOME", "${X}", "n" * 120, "\x85\x01é"),
    ],
)
def test_any_name_is_read_back(bag, name):
    path = bag.with_name(f"{name}.bag").absolute()
    shutil.copyfile(bag, path)
    for command in (["tune", path, "--folder", "out"], ["inspect", path, "--study", "out/x.yaml"]):
        result = commands.call(*command)
        assert "out" in result.output
    for file in ("out/out.yaml", "out/x.yaml"):
        config = study_in(file).config
        (_, *parts) = config.sequences.values()
        assert {part.bag for part in parts} == {str(path)}
        assert len(parts) == len(config.training + config.test) == 2
    assert failed(path, "--folder", "out") == "error: out/out.yaml"  # it resumes
    assert "another `adaptune tune`" in failed(bag, "--folder", "out")


@pytest.mark.usefixtures("decided")
def test_a_name_that_is_no_text_is_refused(bag, tmp_path):
    path = bag.with_name("a\udcff.bag")
    shutil.copyfile(bag, path)
    assert "a\\udcff.bag': holds what is no character in UTF-8; rename it" in failed(path)
    assert not (tmp_path / "runs").exists()


@pytest.mark.usefixtures("decided")
def test_what_it_decides_stands_in_a_study_file(bag, tmp_path):
    assert failed(bag) == "error: runs/one/one.yaml"
    text = (tmp_path / "runs/one/one.yaml").read_text()
    assert "# The part for the test is not trained on.\ntraining:\n- one: 0-60%\n" in text
    study = study_in("runs/one/one.yaml")
    assert study.training == ["one_0-60"]
    assert study.config.test == ("one_60-100",)
    assert study.config.sub_trajectory == 2.0
    assert study.config.offline.trials == TRIALS
    assert study.config.sequences["one"].points == "/points"
    assert study.config.sequences["one"].reference == "/truth"


@pytest.mark.parametrize("n", [1, 3])
def test_each_recording_is_opened_once(decided, tmp_path, monkeypatch, n):
    looked, loaded = [], []
    look, read = BagSource.look_at_clock, loading.read_study
    monkeypatch.setattr(
        BagSource, "look_at_clock", lambda *given: looked.append(given[0].name) or look(*given)
    )
    monkeypatch.setattr(loading, "read_study", lambda *given: loaded.append(1) or read(*given))
    for i in range(n):
        late = [(stamp + i * 10**12, *rest) for stamp, *rest in drives.scans(i)]
        drives.write_bag(tmp_path / f"bags/{i}.bag", late)
    failed("bags")
    assert sorted(looked) == sorted([str(p) for p in tmp_path.glob("bags/*.bag")] * 2)
    assert len(loaded) == 2  # with the least that it may hold, and as it is written
    failed("bags")
    assert (len(looked), len(loaded)) == (2 * n, 3)
    assert decided[0].config == decided[1].config


@pytest.mark.usefixtures("bag")
def test_a_path_of_an_override_begins_at_the_study(decided, tmp_path):
    shutil.copy(tmp_path / "one.bag", tmp_path / "other.bag")
    given = ("one.bag", "--folder", "out", "-o")
    assert f"{tmp_path}/out/other.bag: there is no such" in failed(
        *given, "sequences.one.bag=other.bag"
    )
    for _ in range(2):
        assert failed(*given, "sequences.one.bag=../other.bag") == "error: out/out.yaml"
    assert {s.config.sequences["one"].bag for s in decided} == {str(tmp_path / "other.bag")}


@pytest.mark.parametrize("low", [0.0, 50.0])
def test_a_reference_that_is_surely_noisier_than_an_estimate_is_replaced(
    bag, decided, monkeypatch, caplog, low
):
    error = SimpleNamespace(mean=60.0, low=low, high=70.0)
    measured = SimpleNamespace(is_noisy=lambda _: True, error=lambda _: error)
    monkeypatch.setattr("adaptune.reference.check.measure_reference", lambda *_: measured)
    failed(bag)
    replaced = low > 0.0
    words = "one: its reference is wrong by 60 % (50-70) over 2 m, as registrations of scans tell"
    assert (words in caplog.text) == replaced
    assert ("To insist: `--reference /truth`" in caplog.text) == replaced
    kept = decided[0].config.sequences["one"].reference
    assert kept == study_in("runs/one/one.yaml").config.sequences["one"].reference
    assert kept == ("estimated" if replaced else "/truth")


@pytest.mark.usefixtures("decided")
def test_an_override_of_a_reference_is_insisted_on(bag, monkeypatch):
    asked_for = []
    monkeypatch.setattr(studies, "_less_noisy", lambda *given: asked_for.append(given[1]))
    failed(bag, "-o", "sequences.one.reference=/truth", "--folder", "same")
    failed(bag, "-o", "sequences.one.reference=estimated", "-o", "sequences.one.stop=1")
    assert asked_for == ["one"]


def test_what_the_user_changed_stays(bag, decided, tmp_path):
    failed(bag)
    path = tmp_path / "runs/one/one.yaml"
    path.write_text(path.read_text() + "lost_track: 2.0\n")
    failed(bag, "--trials", 9, "--minutes", 3)
    assert (decided[-1].config.offline.trials, decided[-1].config.offline.hours) == (9, 0.05)
    assert "lost_track: 2.0" in path.read_text()
    said = failed(bag, "--reference", "estimated")
    assert "runs/one/one.yaml: another `adaptune tune` made it: --reference is new;" in said
    assert said.endswith("with `--folder runs/one_2`")
    # Its comments are the user's.
    path.write_text("# mine\n" + path.read_text())
    assert failed(bag) == "error: runs/one/one.yaml"


@pytest.mark.usefixtures("decided")
def test_the_last_of_several_bags_is_the_test(bag, study_file, tmp_path):
    (tmp_path / "other").mkdir()
    shutil.copy(study_file.parent / "three.bag", tmp_path / "other/one.bag")
    failed(bag, study_file.parent / "two.bag", "other/one.bag", "--minutes", 6)
    study = study_in("runs/one_and_more/one_and_more.yaml")
    assert study.training == ["one", "two"]
    assert study.config.test == ("other_one",)
    assert (study.config.offline.trials, study.config.offline.hours) == (None, 0.1)
    assert "one.bag: is named twice; the test" in failed(bag, bag, "--folder", "twice")
    shutil.copy(bag, tmp_path / "other/copy.bag")
    said = failed(bag, "other/copy.bag", "--folder", "twice")
    assert said.startswith("error: test.0: 'copy' is the recording of the training sequence 'one'")


@pytest.mark.parametrize(("given", "why"), [("o'hare", "No closing"), ("a\\", "No escaped")])
def test_quotes_that_do_not_close_are_told(bag, given, why):
    assert f"{given}: {why}" in failed(bag, "--odometry", given)


@pytest.mark.usefixtures("decided")
def test_a_folder_that_grows_changes_only_the_lists_of_its_study(study_file):
    Path("drives").mkdir()
    for name in ("one", "two"):
        shutil.copy(study_file.parent / f"{name}.bag", f"drives/{name}.bag")
    failed("drives", "--as", "several")
    path = Path("runs/drives/drives.yaml")
    text = path.read_text().replace("training:\n- one\n", "training: [  # mine\n  'one' ]  # why\n")
    path.write_text(text.replace("  two:\n", "  two: &b  # on a road\n") + "# the end\n")
    before = path.read_text().splitlines()
    shutil.copy(study_file.parent / "three.bag", "drives/three.bag")
    failed("drives", "--as", "several")
    after = path.read_text().splitlines()
    assert [line for line in before if line not in after] == ["  'one' ]  # why"]
    study = study_in(path)
    assert (study.training, study.config.test) == (["one", "three"], ("two",))
    assert study.config.offline.segments == 24


def test_of_several_odometries_each_has_its_rows_on_the_test(monkeypatch):
    said, shown = [], []
    monkeypatch.setattr("adaptune.commands.tune.say", said.append)
    monkeypatch.setattr(
        "adaptune.commands.tune.show_table", lambda _, rows, *__: shown.extend(rows)
    )
    row = {"set": "its own parameters", COST: 12.0, "test [%]": 1.24, "_state": "complete"}
    tuned = {"odometry": "ndt", "set": "trial 5", "_trial": 5, "test [%]": 0.62}
    lost = {"odometry": "mine:Icp", "_trial": 1, "test [%]": None, "_state": "failed: 10 faults"}
    of_each = [row | tuned, row | {"odometry": "gicp", "_trial": 0}, row | lost]
    training = SimpleNamespace(model=SimpleNamespace(allowed=lambda: (0, 1)))
    say_odometries(SimpleNamespace(of_each=of_each, training=training))
    assert said == [
        "Best odometry on the test: ndt with trial 5, 0.620 % at 12.0 ms a scan. It costs more "
        "than the budget.",
        "Not run on the test: mine:Icp, trial 1: failed: 10 faults.",
    ]
    assert shown == of_each
    say_odometries(SimpleNamespace(of_each=()))
    assert len(said) == 2


@pytest.mark.usefixtures("decided")
def test_several_odometries_share_a_study(bag):
    failed(bag, "--odometry", "gicp,kiss_icp")
    study = study_in("runs/one_gicp+kiss_icp/one_gicp+kiss_icp.yaml")
    assert list(study.config.odometries) == ["gicp", "kiss_icp"]
    assert study.config.offline.trials == 2 * EACH
    every = asked.odometries_of("all", imu=False)
    assert {"gicp", "vgicp", "ndt", "kiss_icp"} <= set(every)
    assert "evalio_kiss_icp" not in every


def test_of_a_launch_command_a_study_is_written_to_fill_in(bag):
    given = ("tune", bag, "--points", "/points", "--odometry")
    done = commands.succeeded(*given, "ros2 launch kiss_icp odometry.launch.py topic:=/points")
    assert "adaptune inspect one_ros2.yaml" in done.output
    text = Path("one_ros2.yaml").read_text()
    assert "- odometry.launch.py\n    - topic:=/points\n    - FILL_IN:={parameters}\n  " in text
    looked = commands.refused("inspect", "one_ros2.yaml")
    lines = [str(n) for n, line in enumerate(text.splitlines(), 1) if "FILL_IN" in line]
    assert len(lines) > 3
    words = f"one_ros2.yaml, line {', '.join(lines)}: fill in what stands as FILL_IN"
    assert words in looked
    # Once it is filled in, it is a study.
    Path("p.yaml").write_text("voxel: 1.0\n")
    Path("one_ros2.yaml").write_text(
        text.replace("template: FILL_IN", "template: p.yaml").replace("FILL_IN:", "voxel:")
    )
    config = load_study(Path("one_ros2.yaml"), [], None, needed=False).config
    assert config.odometries["ros2"].settings["points"] == "/points"
    assert "one_ros2.yaml: exists" in failed(*given[1:], "ros2 launch a b")
    # It is looked for before anything is started, as by the stages.
    filled = Path("one_ros2.yaml").read_text().replace("- ros2\n", "- ros3\n")
    Path("one_ros2.yaml").write_text(filled.replace("FILL_IN", "voxel"))
    words = "a login shell of this machine finds no 'ros3'; source your ROS 2 in ~/.bash_profile"
    assert words in commands.refused("inspect", "one_ros2.yaml")
    refused = failed(*given[1:], "my/kiss-icp:jazzy")
    assert "there is no image 'my/kiss-icp:jazzy'" in refused or "no Docker engine" in refused


@pytest.mark.parametrize(
    ("command", "arguments", "points"),
    [
        ("ros2 launch a b.launch.py", ["FILL_IN:={parameters}", "FILL_IN:={points}"], "/points"),
        ("ros2 launch a b.launch.py points_topic:=/vlp f:={parameters}", [], "/vlp"),
        (
            "ros2 launch a b.launch.py odom_topic:=/odom",
            ["FILL_IN:={parameters}", "FILL_IN:={points}"],
            "/points",
        ),
        (
            "ros2 run a node",
            ["--ros-args", "--params-file", "{parameters}", "-r", "FILL_IN:={points}"],
            "/points",
        ),
        (
            "ros2 run a node --ros-args -r cloud:=/os/points",
            ["--params-file", "{parameters}"],
            "/os/points",
        ),
    ],
)
def test_the_study_of_a_system_asks_for_the_topic_of_the_clouds(bag, command, arguments, points):
    given = ("--points", "/points", "--odometry", command, "--folder", "kept/here")
    done = commands.succeeded("tune", bag, *given)
    assert "adaptune inspect kept/here/one_ros2.yaml" in done.output
    assert "--folder kept/here" in done.output
    assert not Path("one_ros2.yaml").exists()
    settings = Document.of_file(Path("kept/here/one_ros2.yaml")).data["odometry"]["settings"]
    assert settings["command"] == [*command.split(), *arguments]
    assert settings["points"] == points


@pytest.mark.usefixtures("decided")
def test_a_drive_too_short_to_split_is_refused(tmp_path):
    short = drives.write_bag(tmp_path / "short.bag", drives.scans(n_scans=12))
    said = failed(short)
    assert "short: moves 1.2 m in the part for the test, which takes 2 m at least" in said
    assert not (tmp_path / "runs").exists()


@pytest.mark.usefixtures("decided")
def test_a_recording_that_stands_for_long_is_split_by_its_path(tmp_path):
    moving = drives.scans(n_scans=60)
    first, points, T = moving[0]
    standing = [(first - i * 100_000_000, points, T) for i in range(90, 0, -1)]
    late = drives.write_bag(tmp_path / "late.bag", standing + moving)
    # Before it is measured, nobody knows which parts overlap.
    said = failed(late, "-o", "training=[{late: 0-90%}]")
    assert "late_84-100 overlaps late_0-90 of training" in said
    assert not (tmp_path / "runs").exists()
    failed(late, "-o", "training=[{late: 10-84%}]")
    study = study_in("runs/late/late.yaml")
    # It stands for 9 s of 15; 60 % of the way are over after 12.5 s.
    assert study.config.test == ("late_84-100",)
    # `inspect` proposes the same.
    commands.succeeded("inspect", "late.bag", "--study", "proposed.yaml")
    proposed = study_in("proposed.yaml")
    for key in ("training", "test", "sub_trajectory", "sequences"):
        assert getattr(proposed.config, key) == getattr(study.config, key), key


@pytest.mark.usefixtures("decided")
def test_a_reference_that_takes_too_long_is_refused_soon(bag, tmp_path, monkeypatch):
    shown = []

    def estimate(scans, advance):
        shown.append(scans.n_messages)
        for done in range(1, 101):
            advance(done, 200)
        raise AssertionError("it goes on")

    monkeypatch.setattr("adaptune.reference.estimate.estimate_reference", estimate)
    clock = SimpleNamespace(monotonic=count(0.0, 8.0).__next__)
    monkeypatch.setattr("adaptune.tuning.studies.time", clock)
    given = ("--reference", "estimated", "--minutes", 5, "-o", "sequences.one.stop=2")
    said = failed(bag, *given)
    assert "one: estimating its reference alone takes about 27 min, and --minutes is 5:" in said
    assert said.endswith("(`-o sequences.one.stop=SECONDS`); or give a --reference")
    assert shown == [21]  # of 2 s
    assert not list((tmp_path / "runs").iterdir())


@pytest.mark.usefixtures("decided")
def test_motion_within_scans_is_undone_where_the_odometry_does_not(tmp_path):
    course = Course(scenes=("street",), length=15.0, columns=100)
    record(course, tmp_path / "street.bag")
    for odometry, how in (("gicp", "constant_velocity"), ("kiss_icp", None)):
        failed("street.bag", "--odometry", odometry, "--folder", odometry)
        study = study_in(f"{odometry}/{odometry}.yaml")
        assert study.config.sequences["street"].compensate == how
    commands.succeeded("inspect", "street.bag", "--study", "proposed.yaml")
    proposed = study_in("proposed.yaml")
    assert proposed.config.sequences["street"].compensate == "constant_velocity"


@pytest.mark.usefixtures("decided")
def test_of_two_topics_one_is_to_be_named(tmp_path):
    clouds = [(topic, s, drives.cloud(s, xyz)) for s, xyz, _ in drives.scans() for topic in "ab"]
    truth = [
        ("/truth", s, rec.pose(s, T[:3, 3].tolist(), (0.0, 0.0, 0.0, 1.0), rec.ROS1))
        for s, _, T in drives.scans()
    ]
    messages = [(f"/{topic}", s, m) for topic, s, m in clouds] + truth
    rec.write_bag(tmp_path / "both.bag", sorted(messages, key=lambda m: m[1]))
    said = failed("both.bag")
    assert "both.bag: has 2 topics of point clouds: /a (60 of sensor_msgs" in said
    assert said.endswith("name one with --points")
    failed("both.bag", "--points", "/b")
    study = study_in("runs/both/both.yaml")
    assert study.config.sequences["both"].points == "/b"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.bag"], "none.bag: there is no such file"),
        (["poses.tum"], "poses.tum: is a file of poses; give a recording of scans"),
        (["one.bag", "--odometry", "gicb"], "gicb"),
        (["one.bag", "--odometry", "command"], "command: a program needs settings; write a study"),
        (["one.bag", "--points", "/nothing"], "/nothing"),
        (["one.bag", "two.bag", "--reference", "poses.tum"], "of 2 recordings each needs its own"),
        (["poses.yaml"], "poses.yaml: is a study, not a recording"),
        (["one.bag", "--reference", "gt.tum"], "gt.tum"),
        (["one.bag", "--folder", "poses.tum"], "poses.tum: cannot be written to"),
        (["one.bag", "--reference", "/nothing"], "/nothing"),
        (["one.bag", "--reference", "none"], "leave it out, and one is estimated where"),
        (["one.bag", "-o", "offline.trails=3"], "unknown key; did you mean 'trials'?"),
    ],
)
@pytest.mark.usefixtures("bag")
def test_mistakes_are_told_in_a_sentence_and_nothing_is_made(tmp_path, arguments, words):
    (tmp_path / "poses.tum").write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    assert words in failed(*arguments)
    assert not (tmp_path / "runs").exists()


@pytest.mark.usefixtures("bag")
def test_a_wrong_odometry_is_told_before_the_recording_is_read(tmp_path, monkeypatch):
    base = "from adaptune.odometry import Odometry\n\n\n"
    code = f"{base}class Mine(Odometry):\n    live, space = False, {{}}\n"
    (tmp_path / "spaceless.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("adaptune.tuning.asked.usable", lambda *_: pytest.fail("it was read"))
    assert "did you mean 'gicp'" in failed("one.bag", "--odometry", "gicb")
    words = "its `space` is a dict; write it as space = ParameterSpace("
    assert words in failed("one.bag", "--odometry", "spaceless:Mine")


@pytest.mark.services
def test_a_fleet_leaves_each_out_and_grows(tmp_path):
    """A recording more runs only what is new, at the same sets."""

    def add(*names):
        for name in names:
            seed = sum(map(ord, name))
            late = [(stamp + seed * 10**12, *rest) for stamp, *rest in drives.scans(seed)]
            drives.write_bag(tmp_path / "bags" / f"{name}.bag", late)

    add("park", "street", "yard")
    call = ("tune", "bags", *FAKE, "--trials", 4, "-o", "offline.seed=5", "--test", "bags/park.bag")
    said = commands.succeeded(*call).stdout
    assert "Each recording left out, the worst first" in said
    folder = tmp_path / "runs/bags_fake_odometry_Fake"
    study = study_in(folder / f"{folder.name}.yaml").config
    assert ({*study.training}, study.test) == ({"street", "yard"}, ("park",))
    # The same night again changes nothing.
    trials = {path: path.stat().st_mtime_ns for path in folder.glob("trials/*/*.npz")}
    rows = (folder / "trials.csv").read_text().splitlines()
    assert "faults" in rows[0]
    assert "restarts" in rows[0]
    commands.succeeded(*call)
    assert {path: path.stat().st_mtime_ns for path in trials} == trials
    add("alley")
    said = commands.succeeded(*call).stdout
    assert "New in training: alley; " in said
    study = study_in(folder / f"{folder.name}.yaml").config
    assert ({*study.training}, study.test) == ({"street", "yard", "alley"}, ("park",))
    numbers = {path.stem for path in folder.glob("trials/street-*/?????.npz")}
    assert {path.stem for path in folder.glob("trials/alley-*/?????.npz")} == numbers
    assert {path: path.stat().st_mtime_ns for path in trials} == trials
    assert (folder / "trials.csv").read_text().splitlines()[1].startswith(rows[1].split(".")[0])


@pytest.mark.usefixtures("decided")
def test_the_user_s_file_is_the_baseline(bag, tmp_path):
    (tmp_path / "mine.yaml").write_text("mapping: {voxel_size: 0.8}\n")
    assert failed(bag, "--config", "mine.yaml") == "error: runs/one_kiss_icp/one_kiss_icp.yaml"
    study = study_in("runs/one_kiss_icp/one_kiss_icp.yaml")
    assert study.odometry.space.baseline == {"voxel_size": 0.8}
    several = failed(bag, "--config", "mine.yaml", "--odometry", "gicp,ndt", "--folder", "x")
    assert "is of one odometry" in several
    assert "voxel_sise" in failed(bag, "--config", "voxel_sise.yaml", "--folder", "y")


@pytest.mark.usefixtures("decided")
def test_a_folder_is_looked_at(tmp_path):
    folder = tmp_path / "bags"
    for seed, name in enumerate(("park", "street")):
        drives.write_bag(folder / f"{name}.bag", drives.scans(seed))
    failed(folder)
    assert study_in("runs/bags/bags.yaml").config.training == ("park",)
    shown = commands.succeeded("inspect", folder).stdout
    assert "2 recordings" in shown
    assert "Next: adaptune tune" in shown
    assert "--test: leaves no recording" in failed(folder, "--test", folder, "--folder", "z")


@pytest.mark.usefixtures("decided")
def test_what_is_new_goes_where_its_folder_belongs(tmp_path):
    def add(seed, name):
        late = [(stamp + seed * 10**12, *rest) for stamp, *rest in drives.scans(seed)]
        drives.write_bag(tmp_path / f"{name}.bag", late)

    call = ("bags", "--test", "kept", "--folder", "runs/many")
    add(0, "bags/park")
    add(1, "kept/yard")
    failed(*call)
    path = tmp_path / "runs/many/many.yaml"
    path.write_text("# mine\n" + path.read_text().replace("health:", "health:  # a robot's"))
    add(2, "bags/street")
    add(3, "kept/alley")
    failed(*call)
    study = study_in("runs/many/many.yaml").config
    assert (study.training, study.test) == (("park", "street"), ("yard", "alley"))
    text = path.read_text()
    assert text.startswith("# mine\n")
    assert "health:  # a robot's\n  # m/s: twice" in text


PORTFOLIO = """\
odometry: fake_odometry:Fake
sets:
- parameters: {max_correspondence_distance: 4.0, keyframe_interval: 4.0}
- parameters: {max_correspondence_distance: 1.0, keyframe_interval: 4.0}
scans: {rate: [1.0, 2.0], points: [1000, 9000], view: [360, 360]}
"""


@pytest.mark.usefixtures("decided")
def test_a_study_keeps_the_portfolio_that_it_began_with(bag, tmp_path, caplog):
    (tmp_path / "mine.yaml").write_text(PORTFOLIO)
    failed(bag, *FAKE, "--portfolio", "mine.yaml", "--folder", "out")
    what = "its scans are unlike those that the portfolio of fake_odometry:Fake was chosen on"
    assert f"one: {what}: rate 10 (it was chosen on 1 to 2)" in caplog.text
    study = study_in("out/out.yaml")
    assert list(study.config.offline.portfolio) == [str(tmp_path / "mine.yaml")]
    assert [one["max_correspondence_distance"] for one in study.portfolio] == [1.0]
    again = failed(bag, *FAKE, "--folder", "out")
    assert "another `adaptune tune` made it: --portfolio" in again
    failed(bag, *FAKE, "--portfolio", "none", "--folder", "without")
    assert study_in("without/without.yaml").portfolio == ()


@pytest.mark.usefixtures("decided")
def test_a_portfolio_that_cannot_be_used_is_refused_at_once(bag, tmp_path):
    (file := tmp_path / "mine.yaml").write_text(PORTFOLIO.replace("sets:", "set:"))
    said = failed(bag, *FAKE, "--portfolio", "mine.yaml")
    assert f"{file}, line 2: set: unknown key; did you mean 'sets'?" in said
    file.write_text(PORTFOLIO)
    said = failed(bag, "--odometry", "kiss_icp", "--portfolio", file)
    assert f"{file}: odometry: is of fake_odometry:Fake, and tuned is kiss_icp" in said
    assert f"{tmp_path}/no.yaml: there is no such file" in failed(bag, "--portfolio", "no.yaml")
