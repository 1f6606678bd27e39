import pytest
from commands import refused, succeeded

from adaptune._system import yaml12
from adaptune._system.strict import ConfigurationError
from adaptune.odometry.systems import rustle as docker_rustle
from adaptune.space import ParameterSpace
from offline.config import OfflineConfig, load_study

PARAMETERS = """
common: {lid_topic: /velodyne_points, imu_topic: /imu/data}
mapping: {acc_cov: 0.1, extrinsic_T: [0, 0, 0.3], weighting: huber, deskew: true}
vio: {max_iterations: 5}
lio: {max_iterations: 4}
filter_size_surf: 0.5
point_filter_num: 3
"""
ALGORITHMS = """
algorithms:
  - name: faster-lio
    version: "1.1.1"
    image_name: "mjpc13/rustle:faster-lio"
    parameters: config/params.yaml
    odom_topics: ["/Odometry", "/path"]
  - name: kiss
    version: 1.0
    image_name: "local/kiss:jazzy"
    parameters: config/params.yaml
    odom_topics: ["/kiss/odometry"]
    ros_version: ROS_2
"""
DATASETS = """
datasets:
  - name: "botanic garden"
    ground_truth_topic: /gt_poses
    dataset_path: bags/
    tag: ["Botanic"]
  - {name: other, groundtruth_topic: /gt, dataset_path: no/where}
"""
TESTS = """
test_definitions:
  - name: simple
    workers: 2
    iterations: 5
    algo_list: [faster-lio, kiss]
    dataset_name: "botanic garden"
    test_type: {type: simple}
  - name: fast
    num_iterations: 1
    algo_list: [faster-lio]
    dataset_name: other
    test_type: {type: speed, speed_range: 3, speed_step: 1}
  - name: dropping
    workers: 1
    iterations: 1
    algo_list: [faster-lio]
    dataset_name: other
    test_type:
      type: drop
      drop_list: [{sensor: imu, drop_rate: [5, 10], topic: /imu/data}]
"""
TUNING = """
name: "grid of two"
algo_name: faster-lio
dataset_settings: {name: "botanic garden", start: 10.0, duration: -1.0}
metric_weights: {ape: 1.0, rpe: 3.0}
early_stopping: {tolerance: 4, delta: 0.01}
tuning_algo: grid_search
parameters:
  filter_size_surf: [0.2, 0.1, 3]
  point_filter_num: [4, 2, 3]
"""
ANNEALING = """
name: annealed
algo_name: faster-lio
dataset_settings: {name: "botanic garden", start: 0.0, duration: 60.0}
metric_weights: {rpe: 1.0}
early_stopping: {tolerance: 3, delta: 0.01}
time_limit: 5.0
tuning_algo: simulated_annealing
tuning_settings:
  temperature: {initial_value: 1.0, function: boltzman}
  reanneal: {fixed: 10, accepted: 9, best: 0}
  halting_conditions: {accepted: 20, best: 30}
  perturbation_functions: {integer_delta_max: 3, float_mean: -0.5, float_std_dev: 0.4}
  max_iterations: 100
  parameter_bounds:
    filter_size_surf: [1.0, 0.25, 1.25, -0.01, 0.003]
    point_filter_num: [20, 5, 50]
    vio/max_iterations: [10, 3, 50, 5]
"""


@pytest.fixture
def rustle(tmp_path, monkeypatch):
    """A folder with RUSTLE's files, on a machine with the images."""
    monkeypatch.setattr(docker_rustle, "image_digest", lambda _: "as if it were here")
    monkeypatch.chdir(tmp_path)
    for folder in ("config", "bags"):
        (tmp_path / folder).mkdir()
    (tmp_path / "bags/a.bag").touch()
    (tmp_path / "config/params.yaml").write_text(PARAMETERS)
    files = {"algorithms": ALGORITHMS, "datasets": DATASETS, "tests": TESTS}
    for name, text in (files | {"tuning": TUNING, "annealing": ANNEALING}).items():
        (tmp_path / f"{name}.yaml").write_text(text)
    return tmp_path


def read(path):
    return yaml12.Document(path.read_text(encoding="utf-8")).data


def check(path):
    """A study is complete, but for its bag."""
    data = read(path)
    space = ParameterSpace.load(data["odometry"]["parameters"])
    config = OfflineConfig.model_validate(data["offline"])
    assert not list(config.mistakes(space))
    with pytest.raises(ConfigurationError) as caught:
        load_study(path)
    assert all(": sequences." in line for line in str(caught.value).splitlines())
    return config


def test_every_test_algorithm_and_speed_is_a_study(rustle, caplog):
    (rustle / "made").mkdir()
    done = succeeded("import-rustle", "tests.yaml", "-o", "made/s.yaml")
    names = sorted(path.name for path in (rustle / "made").iterdir())
    assert names == [
        *(f"s_fast_faster-lio_x{speed}.yaml" for speed in (1, 2, 3)),
        "s_simple_faster-lio.yaml",
    ]
    simple = read(rustle / "made/s_simple_faster-lio.yaml")
    assert simple["odometry"]["settings"] == {
        "image": "mjpc13/rustle:faster-lio",
        "template": str(rustle / "config/params.yaml"),
        "odometry": "/Odometry",
        "points": "/velodyne_points",
        "imu": "/imu/data",
        "rate": 1.0,
    }
    assert simple["sequences"] == {
        "botanic_garden": {
            "bag": str(rustle / "bags/a.bag"),
            "points": "/velodyne_points",
            "imu": {"topic": "/imu/data"},
            "reference": "/gt_poses",
        }
    }
    assert simple["training"] == ["botanic_garden"]
    assert simple["odometry"]["parameters"] == {
        "mapping/acc_cov": {"type": "float", "low": 0.05, "high": 0.2, "baseline": 0.1},
        "vio/max_iterations": {"type": "integer", "low": 3, "high": 10, "baseline": 5},
        "lio/max_iterations": {"type": "integer", "low": 2, "high": 8, "baseline": 4},
        "filter_size_surf": {"type": "float", "low": 0.25, "high": 1.0, "baseline": 0.5},
        "point_filter_num": {"type": "integer", "low": 2, "high": 6, "baseline": 3},
    }
    config = check(rustle / "made/s_simple_faster-lio.yaml")
    assert (config.trials, config.baseline_runs, config.workers) == (1, 5, 2)
    fast = read(rustle / "made/s_fast_faster-lio_x3.yaml")
    assert fast["odometry"]["settings"]["rate"] == 3.0
    for told in (
        "adaptune has no drop tests",
        "'simple' is left out for kiss, an image of ROS 2",
        "further topics of poses: /path",
        "no/where here: correct the path of the bag",
    ):
        assert told in caplog.text
    text = (rustle / "made/s_fast_faster-lio_x3.yaml").read_text()
    # Paths are as long as they are.
    assert max(len(line) for line in text.splitlines() if "/" not in line) <= 100
    assert "TES, FPT" in text
    assert done.stdout.splitlines()[-1].startswith("Next: adaptune offline made/s_simple")


def test_a_grid_keeps_its_points_and_its_weights(rustle, caplog):
    succeeded("import-rustle", "tuning.yaml")
    study = read(rustle / "study.yaml")
    assert study["odometry"]["parameters"] == {
        "filter_size_surf": {
            "type": "float",
            "low": 0.2,
            "high": pytest.approx(0.5),
            "baseline": 0.5,
        },
        "point_filter_num": {"type": "integer", "low": 3, "high": 8, "baseline": 3},
    }
    config = check(rustle / "study.yaml")
    assert config.sampler == "grid"
    assert config.objective == {"ape": 0.25, "rpe": 0.75}
    assert (config.stagnation, config.hours, config.trials) == (4, None, None)
    (sequence,) = study["sequences"].values()
    assert sequence["start"] == 10.0
    assert "stop" not in sequence
    assert "early_stopping.delta has no counterpart" in caplog.text
    assert "give odometry.settings points" not in caplog.text


def test_a_random_search_ends_with_the_grid(rustle):
    text = TUNING.replace("grid_search", "random_search").replace(
        "tolerance: 4, ", "tolerance: 9, "
    )
    (rustle / "tuning.yaml").write_text(text + "  weighting: [cauchy, huber]\n  deskew: true\n")
    succeeded("import-rustle", "tuning.yaml")
    config = check(rustle / "study.yaml")
    assert (config.sampler, config.trials) == ("random", 3 * 3 * 2 + 1)
    study = read(rustle / "study.yaml")
    assert study["odometry"]["parameters"]["weighting"] == {
        "type": "categorical",
        "choices": ["cauchy", "huber"],
        "baseline": "huber",
    }
    assert "deskew is fixed at True" in (rustle / "study.yaml").read_text()


def test_annealing_keeps_starts_bounds_and_steps(rustle, caplog):
    succeeded("import-rustle", "annealing.yaml")
    config = check(rustle / "study.yaml")
    assert config.sampler_settings == {
        "chains": 1,
        "energy_scale": 1.0,
        "initial_temperature": 1.0,
        "alpha": 0.95,
        "reanneal_fixed": 10,
        "reanneal_accepted": 9,
        "stall_accepted": 20,
        "stall_best": 30,
        "start": {"filter_size_surf": 1.0, "point_filter_num": 20, "vio/max_iterations": 10},
        "steps": {
            "filter_size_surf": {"mu": -0.01, "sigma": 0.003},
            "point_filter_num": {"delta_max": 3, "low": 5},
            "vio/max_iterations": {"delta_max": 5},
        },
    }
    assert (config.trials, config.hours, config.batch, config.initial) == (101, 5.0, 1, 1)
    study = read(rustle / "study.yaml")
    assert study["odometry"]["parameters"]["point_filter_num"]["low"] == 3
    (sequence,) = study["sequences"].values()
    assert sequence["stop"] == 60.0
    assert "function boltzman has no counterpart" in caplog.text
    assert "default of point_filter_num lies outside" in caplog.text


def test_nothing_is_overwritten_unasked(rustle):
    (rustle / "study.yaml").write_text("mine")
    said = refused("import-rustle", "tuning.yaml")
    assert "study.yaml: exists; name another -o, or add --overwrite" in said
    assert (rustle / "study.yaml").read_text() == "mine"
    succeeded("import-rustle", "tuning.yaml", "--overwrite")


@pytest.mark.parametrize(
    ("name", "old", "new", "told"),
    [
        (
            "tests",
            "algo_list: [faster-lio, kiss]",
            "algo_list: [faster]",
            "line 6: test_definitions.0.algo_list.0: algorithms.yaml has no 'faster' in",
        ),
        ("tests", "type: simple", "type: slow", "test_definitions.0.test_type.type: give"),
        ("tests", "speed_step: 1", "speed_step: 1e-6", "speed_step: makes 2000001 speeds; 100"),
        ("algorithms", "config/params.yaml", "no.yaml", "algorithms.yaml, line 6: algorithms.0."),
        ("datasets", "datasets:", "- 1", "datasets.yaml: "),
        ("tuning", "filter_size_surf", "filter_size", "parameters.filter_size: params.yaml has no"),
        ("tuning", "[4, 2, 3]", "[4, 2]", "give [first, step, number], not [4, 2]"),
        ("tuning", "point_filter_num", "max_iterations", "max_iterations' may be any of vio.max_"),
        ("tuning", "grid_search", "simulated_annealing", "tuning_settings: is missing"),
        ("annealing", "[20, 5, 50]", "[2, 5, 50]", "low below high and first in them"),
        ("annealing", ", -0.01, 0.003]", ", 3]", "[first, low, high, mean, standard deviation]"),
    ],
)
def test_mistakes_are_named_with_file_line_and_key(rustle, name, old, new, told):
    path = rustle / f"{name}.yaml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    imported = "tests.yaml" if name in ("algorithms", "datasets") else path.name
    assert told in refused("import-rustle", imported)
    assert not list(rustle.glob("study*"))
