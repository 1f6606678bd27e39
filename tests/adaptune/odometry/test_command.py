import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import program
import pytest
import yaml
from made_drives import described, trials_of
from odometry_node import path
from setups import setup_of

from adaptune._system.strict import ConfigurationError
from adaptune.errors import OdometryError
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.program import CommandSettings, ProgramInput, WholeRun
from adaptune.odometry.remote import Limits
from adaptune.odometry.template import Template
from adaptune.recording import Scan
from adaptune.runs.archive import Archive
from adaptune.runs.record import Run
from adaptune.trajectory import Trajectory
from offline.campaign import BaselineError
from offline.config import load_study
from offline.train import train
from offline.trial_table import rows
from online.compare import compare
from online.modes import run_replays

STUDY = """\
odometry:
  name: command
  settings:
    command: [{python}, "{{study}}/program.py", "{{input}}", "{{points}}", "{{output}}",
              "{{parameters}}", "{fault}"]
    template: file.json
  parameters:
    registration.voxel: {{type: float, low: 0.2, high: 2.0, baseline: 0.5, log: true}}
    distance: {{type: float, low: 0.05, high: 4.0, baseline: 2.0, log: true}}
sequences:
  one: {{bag: "{bags}/one.bag", points: /points, reference: /truth}}
  two: {{bag: "{bags}/two.bag", points: /points, reference: /truth}}
training: [one]
test: [two]
sub_trajectory: 3.0
isolation: {{seconds: 2, memory: 4}}
offline: {{trials: 3, initial: 3, seed: 3, workers: 1}}
"""

TEMPLATE = '{"registration": {"voxel": 1.0, "distance": 3.0}, "names": ["a", "b"]}'


@pytest.fixture
def make(tmp_path, study_file):
    (tmp_path / "program.py").write_text(Path(program.__file__).read_text())

    def study(fault="none", *overrides):
        (tmp_path / "file.json").write_text(TEMPLATE)
        text = STUDY.format(python=sys.executable, fault=fault, bags=study_file.parent)
        (tmp_path / "study.yaml").write_text(text)
        return load_study(tmp_path / "study.yaml", overrides, tmp_path / "runs")

    return study


OTHER = {"registration.voxel": 0.6, "distance": 2.0}


def run(study):
    setup = setup_of(study)
    frames = described(setup)
    (trial,) = trials_of(setup, [OTHER], frames=frames)
    return trial, frames


def test_the_poses_are_the_program_s(make):
    study = make()
    trial, frames = run(study)
    assert not trial.faults
    assert not trial.restarted.any()
    np.testing.assert_allclose(
        trial.T_odom_sensor[:, :3, 3], frames.T_ref_sensor[:, :3, 3], atol=0.1
    )
    # It is what the program finds with these values.
    output, file = study.folder / "alone.tum", study.folder / "alone.json"
    file.write_text('{"registration": {"voxel": 0.6, "distance": 2.0}}')
    program.main(study.config.sequences["one"].bag, "/points", str(output), str(file))
    np.testing.assert_allclose(trial.T_odom_sensor[:, :3, 3], np.loadtxt(output)[:, 1:4], atol=1e-6)


FILLED = {"voxel": 1e-05, "distance": 2.0}


@pytest.mark.parametrize(
    ("name", "template", "expected"),
    [
        (
            "ros1.yaml",
            "# of ROS 1\nodometry/registration: {voxel: 1, distance: 3.0}\nframe: on\n",
            {"odometry/registration": FILLED, "frame": True},
        ),
        (
            "ros2.yaml",
            "/**:\n  ros__parameters:\n    registration.voxel: 1.0\n"
            "    registration.distance: 3.0\n",
            {"/**": {"ros__parameters": {f"registration.{k}": v for k, v in FILLED.items()}}},
        ),
        ("file.json", TEMPLATE, {"registration": FILLED, "names": ["a", "b"]}),
        ("tabs.json", TEMPLATE.replace(" ", "\n\t"), {"registration": FILLED, "names": ["a", "b"]}),
    ],
)
def test_every_layout_of_parameters(tmp_path, name, template, expected):
    path = tmp_path / name
    path.write_text(template)
    text = Template(path).fill({"registration.voxel": 1e-05, "distance": 2.0, "other": 1})
    # YAML as programs that go by version 1.1 read it.
    read = {".json": json.loads, ".yaml": yaml.safe_load}
    assert read[path.suffix](text) == expected


def test_json_that_only_yaml_reads_is_no_template(tmp_path):
    path = tmp_path / "file.json"
    path.write_text('{"voxel": 1.0,}')
    with pytest.raises(OdometryError, match=r"file\.json: .*line 1 column"):
        Template(path)


@pytest.mark.parametrize(("name", "kind"), [("poses/run.csv", "evalio"), ("run.txt", "kitti")])
def test_every_format_of_trajectories(make, name, kind):
    settings = [f"odometry.settings.output={name}", f"odometry.settings.format={kind}"]
    trial, frames = run(make("pretend", *settings))
    assert not trial.faults
    np.testing.assert_allclose(trial.T_odom_sensor, frames.T_ref_sensor, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "points"), [("bag", "{points}"), ("ros2", "{points}"), ("kitti", "")]
)
def test_a_part_is_written_once_for_the_program(make, kind, points):
    arguments = f'"{{study}}/program.py", "{{input}}", "{points}", "{{output}}", "{{parameters}}"'
    study = make(
        "none",
        f"odometry.settings.command=[{sys.executable}, {arguments}]",
        "isolation.seconds=5",
        f"odometry.settings.input={kind}",
        f"odometry.settings.format={'kitti' if kind == 'kitti' else 'tum'}",
        f"odometry.settings.output=run.{'txt' if kind == 'kitti' else 'tum'}",
        "sequences.one.stop=3.5",
    )
    trial, frames = run(study)
    assert not trial.faults
    assert len(trial.T_odom_sensor) == len(frames.stamps) == 35
    np.testing.assert_allclose(
        trial.T_odom_sensor[:, :3, 3], frames.T_ref_sensor[:, :3, 3], atol=0.15
    )
    (written,) = (study.folder / "inputs" / "one").glob("input*")
    before = written.stat().st_mtime_ns
    run(study)
    assert written.stat().st_mtime_ns == before


def test_a_program_that_stamps_the_end_of_a_scan(make):
    trial, _ = run(make("late"))
    assert not trial.faults
    assert not trial.restarted.any()
    assert np.nanmax(trial.errors) < 5.0


def test_scans_before_the_first_pose_are_unknown_and_do_not_count(make):
    polite, _ = run(make("polite"))
    study = make("begins after 3")
    trial, _ = run(study)
    assert not trial.faults
    assert not trial.restarted.any()
    assert np.isnan(trial.errors[:3]).all()
    np.testing.assert_allclose(trial.errors[3:], polite.errors[3:], atol=1e-4)
    assert trial.metrics["ape"] < 1e-4
    assert trial.metrics["rpe"] < 1e-4
    assert trial.others["first_pose"] == pytest.approx(0.3)
    assert not trial.failure
    train(study)
    table = rows(Archive(study.folder / "trials"), ["one"])
    assert [row["first_pose"] for row in table] == pytest.approx([0.3] * 3)
    run_replays(study, study.model_path)
    for row in compare(study).rows:
        assert row.run.restarts == 0
        assert row.rte < 1e-3
        assert row.standard.ape < 1e-4


def test_what_it_takes_is_measured(make):
    once = "offline.trials=1"
    objective = "{rte: 1, cpu: 0.001, ms_per_scan: 0.001}"
    study = make("work", f"offline.objective={objective}", once)
    trial, _ = run(study)
    # It computes for half a second with 200 MB, over 40 scans of 3.9 s.
    assert 12.5 <= trial.ms < 200.0
    assert 100 * 0.5 / 3.9 <= trial.others["cpu"] < 200.0
    assert 200.0 <= trial.others["memory"] < 1000.0
    assert len(train(study).trials) > 0
    # A replay counts the program's CPU time, too.
    run_replays(study, study.model_path)
    assert all(row.run.cpu_ms > 12.5 for row in compare(study).rows)
    late = make("hang", "isolation.seconds=0.02")
    trial, _ = run(late)
    assert trial.faults
    assert trial.ms >= 20.0
    assert trial.others["memory"] > 5.0


def test_another_frame(make):
    (fault,) = run(make("camera"))[0].reasons
    assert re.search(r"another frame: turned by 120 degrees.*extrinsic.*: read", fault)
    lidar = "[[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]"
    trial, frames = run(make("camera", f"odometry.settings.extrinsic={lidar}"))
    np.testing.assert_allclose(trial.T_odom_sensor, frames.T_ref_sensor, atol=1e-6)


FAULTS = {
    "exit": "its process ended with code 1: .*no planes here",
    "abort": "its process was ended by SIGABRT",
    "hang": r"longer than isolation.seconds = 0\.1 for each scan: reading one\.bag",
    "memory": "code 1: .*MemoryError",
    "nothing": r"it left no trajectory\.tum: reading one\.bag",
    "half": r"poses for 2[01] of 40 scans; the first pose at 0\.0 s, .*last at .* of 3\.9 s",
    "begins after 5": r"35 of 40 scans; the first pose at 0\.5 s, the last at 3\.9 s of 3\.9 s",
    "cut": r"trajectory\.tum, line 42: a TUM line has 8 numbers",
    "backwards": "line 4: its stamp does not come after the line before",
    "clock": "its poses are of 0.000 s to 3.900 s, the scans of 1700000000",
    "NaN": "line 8: a number is not finite",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_with_the_last_lines(make, fault):
    study = make(fault, *["isolation.seconds=0.1"][: fault == "hang"])
    trial, _ = run(study)
    (told,) = trial.reasons
    assert re.search(FAULTS[fault], told, re.DOTALL), told
    assert re.fullmatch(r"no pose for \d+ of 40 scans", trial.failure)
    assert fault.startswith("begins") or trial.mean_error > 1.0


# As KISS-ICP's program leaves it: a folder with other files, and a link to the latest.
LEAVES = (
    "mkdir -p results/now; ln -s $PWD/results/now results/latest; ln -s /etc etc; "
    "touch results/now/config.yml; "
    "{python} {{study}}/program.py {{input}} {{points}} results/now/one_poses.tum x pretend"
)


@pytest.mark.parametrize(
    ("output", "told"),
    [
        # Patterns, and links within the folder.
        ("results/latest/one_poses.tum", None),
        ("results/latest/*_poses.tum", None),
        ("results/*/o?e_poses.t[tu]m", None),
        ("results/*/*", "2 files fit results/*/*; there are {}"),
        ("*.tum", "it left no *.tum; there are {}"),
        ("etc/*", "it left no etc/*; there are {}"),
        ("etc/passwd", "it left no etc/passwd; there are {}"),
    ],
)
def test_one_file_that_fits_is_the_trajectory(make, output, told):
    script = LEAVES.format(python=sys.executable)
    study = make(
        "pretend",
        f"odometry.settings.command=[sh, -c, '{script}', '{{registration.voxel}}{{distance}}']",
        f"odometry.settings.output='{output}'",
        "odometry.settings.template=",
    )
    trial, frames = run(study)
    if told is None:
        assert not trial.faults
        np.testing.assert_allclose(trial.T_odom_sensor, frames.T_ref_sensor, atol=1e-6)
    else:
        told = told.format("results/now/config.yml, results/now/one_poses.tum")
        (fault,) = trial.reasons
        assert fault.startswith(f"{told}; let odometry.settings.output fit just one file")


def test_where_every_set_is_lost_it_is_said_first(make):
    said = train(make("jump", "offline.trials=2")).words
    assert said[0].startswith(
        "Even with the fixed set, the best of 2 parameter sets, track is lost on one: "
    )
    assert "gicp holds track on one" in said[0]


def test_with_the_baseline_s_parameters_something_else_than_these_is_wrong(make):
    study = make("exit")
    with pytest.raises(BaselineError, match=r"one: command fails .*code 1: .*no planes here"):
        train(study)
    assert not list(study.folder.rglob("*.npz"))


def test_poses_without_stamps_that_are_too_many_or_not_rigid(make):
    kitti = ["odometry.settings.output=run.txt", "odometry.settings.format=kitti"]
    for fault, more, told in (
        ("not rigid", [], "run.txt, line 4: its numbers are no rigid pose"),
        ("half", [], "20 of 40 scans"),
        ("pretend", ["sequences.one.stop=2.0"], "40 poses without stamps for 20 scans"),
    ):
        assert told in run(make(fault, *kitti, *more))[0].reasons[0]


def test_after_a_jump_the_health_check_goes_on_with_the_program_s_poses(make, monkeypatch):
    monkeypatch.setattr(HealthCheck, "max_acceleration", 10.0)
    trial, _ = run(make("jump"))
    jumped = 0.3 * np.arange(20, 40)
    jumped[:9] += 2.0  # which the odometry might have taken back
    np.testing.assert_allclose(trial.T_odom_sensor[20:, 0, 3], jumped)
    assert np.flatnonzero(trial.restarted).tolist() == [29]


def test_the_whole_way(make, caplog):
    study = make("pretend", "offline.trials=2")
    training = train(study)
    assert training.model.sets.space.names == ("registration.voxel", "distance")
    # Where the fixed set is the baseline, both are one replay.
    assert run_replays(study, study.model_path) == len({0, training.model.fixed})
    assert {row.mode for row in compare(study).rows} == {"baseline", "fixed"}
    fixed = training.model.sets[training.model.fixed]
    filled = json.loads((study.folder / "fixed_command.json").read_text())
    assert filled["registration"] == {key.split(".")[-1]: value for key, value in fixed.items()}
    file = study.folder.parent / "file.json"
    file.write_text(file.read_text() + " ")
    train(study)
    assert "2 trials are run again: " in caplog.text
    assert "file.json has other content" in caplog.text


def test_no_mode_pays_for_writing_a_part(make, monkeypatch):
    study = make("pretend", "offline.trials=2")
    train(study)
    shutil.rmtree(study.folder / "inputs")
    monkeypatch.setattr("adaptune.study.sequences._inputs", {})
    begin, written = Run.begin, []

    def note(record):
        written.append(any((study.folder / "inputs").rglob("stamps.npy")))
        begin(record)

    monkeypatch.setattr(Run, "begin", note)
    run_replays(study, study.model_path)
    assert written[0]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("odometry.parameters=", "odometry.parameters: define the parameters"),
        ("odometry.parameters.distance.type=real", "give its type, one of float, integer"),
        ("odometry.parameters.distance.low=9", "low (9) must be less than high"),
        (
            "odometry.parameters.voxl={type: integer, low: 1, high: 2, baseline: 1}",
            "voxl: no argument holds {voxl}, and file.json has no such value",
        ),
        ("odometry.settings.template=no.yaml", "no.yaml: there is no such file"),
        ("odometry.settings.template=", "voxel}, and there is no template"),
        ("odometry.settings.command=[slam3000, x]", "there is no program 'slam3000'"),
        ("odometry.settings.command=[sh, '{ouput}']", "{ouput} is nothing; did you mean 'output'?"),
        ("odometry.settings.output=.", "output: give a path in the program's working folder"),
        ("odometry.settings.output=/x.tum", "output: give a path in the program's working folder"),
        ("odometry.settings.output=a/../../x.tum", "output: give a path in the program's working"),
        ("odometry.settings.inpt=bag", "did you mean 'input'?"),
        ("online.switching.mechanism=bank", "command runs whole recordings and cannot change"),
        ("odometry.settings.command=sh", "settings.command: give a list, not 'sh'"),
    ],
)
def test_mistakes_in_the_study(make, override, words):
    with pytest.raises(ConfigurationError) as caught:
        make("none", override)
    assert words in str(caught.value)


class OfEnds(WholeRun):
    """Gives poses of the ends of scans, with their stamps."""

    def trajectory(self, given, _):
        seconds = 1e-9 * (given.stamps - given.stamps[0] + given.span)
        return Trajectory(given.stamps, path(seconds))


@pytest.mark.parametrize(("pose_time", "right"), [("stamp", False), ("end", True)])
def test_poses_of_the_end_are_carried_back(pose_time, right):
    stamps = 10**12 + 10**8 * np.arange(30)
    given = ProgramInput(Path("a.bag"), "/points", "", stamps, None, span=99_000_000)
    settings = CommandSettings(command=["x"], pose_time=pose_time)
    odometry = OfEnds({}, settings, Limits(), lambda: given)
    scans = [odometry.prepare(Scan(int(s), np.zeros((1, 3), np.float32))) for s in stamps]
    poses = np.array([odometry.start(scans[0], np.eye(4)) or np.eye(4)])
    found = [odometry.register(scan).T_odom_sensor for scan in scans[1:]]
    off = np.concatenate([poses, found])[:, :3, 3] - path(1e-9 * (stamps - stamps[0]))[:, :3, 3]
    assert bool(np.linalg.norm(off, axis=1).max() < 0.03) is right
