"""What adaptune adds to the work that any program would have to do.

    python benchmarks/stages.py FOLDER_OF_RECORDED_DATA

Each figure is a ratio against a bare loop over the same clouds in the same run: the median over
alternating repetitions, each on one core. Limits: trial 1.15, replay 1.15, descriptor of 100,000
points 3 ms, RTE of 4541 poses over 100 m 10 ms.
"""

import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import small_gicp

from adaptune._system import machine
from adaptune.geometry import Poses
from adaptune.metrics import sub_trajectory_rte
from adaptune.model import ErrorModel
from adaptune.model.ndt import ndt_histogram
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.keyframe import crop
from adaptune.recording import SequenceConfig
from adaptune.recording.recording import open_sequence
from adaptune.runs.loop import replay
from adaptune.runs.record import Run
from adaptune.selector import Selector
from adaptune.space import ParameterSet, Selection
from adaptune.trajectory import read_kitti
from offline.config import OfflineStudy, load_study
from offline.drive import TrialSetup, drive_sets, trial_of
from offline.frames import describe, segments_along
from offline.shared_scans import SharedScans
from offline.train import train

REPETITIONS = 5
UNCACHED = [f"sequences.{name}.cache=false" for name in ("hall_begin", "hall_end", "street")]
"""Reading is part of a replay from the bag."""


def seconds(function: Callable[[], object]) -> float:
    """Time one call."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def compare(name: str, ours: Callable[[], object], bare: Callable[[], object]) -> None:
    """Print the median of the ratios of alternating runs."""
    pairs = [(seconds(ours), seconds(bare)) for _ in range(REPETITIONS)]
    ratios = [a / b for a, b in pairs]
    a, b = np.median(pairs, axis=0)
    print(f"{name:34} {a:8.3f} s   bare {b:8.3f} s   ratio {np.median(ratios):.3f}")


def bare_gicp(
    prepared: list[tuple[small_gicp.PointCloud, small_gicp.KdTree]],
    distance: float,
    interval: float,
    iterations: int,
) -> Poses:
    """Keyframe GICP with nothing around it."""
    keyframe, tree = prepared[0]
    T_odom_keyframe, T_keyframe_sensor, T_step = np.eye(4), np.eye(4), np.eye(4)
    poses = [T_odom_keyframe]
    for cloud, its_tree in prepared[1:]:
        result = small_gicp.align(
            keyframe,
            cloud,
            tree,
            init_T_target_source=T_keyframe_sensor @ T_step,
            max_correspondence_distance=distance,
            max_iterations=iterations,
        )
        T_step = np.linalg.inv(T_keyframe_sensor) @ result.T_target_source
        T_keyframe_sensor = result.T_target_source
        poses.append(T_odom_keyframe @ T_keyframe_sensor)
        if np.linalg.norm(T_keyframe_sensor[:3, 3]) >= interval:
            keyframe, tree = cloud, its_tree
            T_odom_keyframe, T_keyframe_sensor = poses[-1], np.eye(4)
    return np.array(poses)


def trial(study: OfflineStudy) -> None:
    """One trial over prepared scans."""
    setup = TrialSetup(study.config, study.odometry, study.sequences)
    frames = describe(study.config, study.sequences, "hall_begin").uncut
    (segment,) = segments_along("hall_begin", frames)
    shared, read = SharedScans(8e9), study.sequences.open("hall_begin")
    parameters: ParameterSet = {"max_correspondence_distance": 2.0, "keyframe_interval": 1.0}
    instance = study.odometry(parameters)
    scans = (load(instance) for load in shared.along(segment, read))
    prepared = [(scan.cloud, scan.tree) for scan in scans]
    iterations = study.odometry.settings.iterations

    def ours() -> None:
        (drives,) = drive_sets(setup, shared, read, segment, [parameters])
        trial_of(study.config, parameters, frames, {0: drives})

    compare(
        f"trial, {len(prepared)} scans",
        ours,
        lambda: bare_gicp(prepared, 2.0, 1.0, iterations),
    )


class KeepsFixed(Selector):
    """Does all the work of a selection, then keeps the fixed set, as the bare loop does."""

    def __init__(self, model: ErrorModel, rule: str):
        self._parameters = model.sets[model.fixed]
        super().__init__(model, rule, ())

    def select(self) -> Selection:
        """See `Selector.select`."""
        return super().select()._replace(trial=self.fixed, parameters=self._parameters)


def adaptive_replay(study: OfflineStudy, model: ErrorModel) -> None:
    """Replay from the bag, selecting once a second, against read, prepare and align."""
    fixed: Any = model.sets[model.fixed]
    street = study.sequences.open("street")
    settings = study.odometry.settings

    def replayed(selector: Selector) -> Run:
        selector.reset()
        return replay(street, study.odometry(fixed), HealthCheck(), selector)

    def bare() -> object:
        prepared = [
            small_gicp.preprocess_points(
                crop(scan, settings.min_range), downsampling_resolution=settings.downsampling
            )
            for scan in street
        ]
        return bare_gicp(
            prepared,
            fixed["max_correspondence_distance"],
            fixed["keyframe_interval"],
            settings.iterations,
        )

    begin = time.perf_counter()
    result = replayed(Selector(model, "adaptive", ()))
    seconds = time.perf_counter() - begin
    keeps_fixed = KeepsFixed(model, "adaptive")
    stamps = result.trajectory.stamps
    duration = (stamps[-1] - stamps[0]) * 1e-9
    print(
        f"replay: {duration / seconds:.2f} times real time; selections take "
        f"{1e3 * np.median([c.seconds for c in result.choices]):.2f} ms"
    )
    compare("adaptive replay of street.bag", lambda: replayed(keeps_fixed), bare)


def main(folder: Path) -> None:
    """Measure everything."""
    machine.pin(0)
    bag = str(folder / "hilti_2022_scan.bag")
    points = next(iter(open_sequence(SequenceConfig(bag=bag)))).points
    rng = np.random.default_rng(0)
    more = points[: 100_000 - len(points)]
    noise = rng.normal(0.0, 0.02, more.shape).astype(np.float32)
    cloud = np.concatenate([points, more + noise])
    ndt_histogram(cloud)
    times = [seconds(lambda: ndt_histogram(cloud)) for _ in range(50)]
    print(f"descriptor, {len(cloud)} points: {1e3 * np.median(times):.2f} ms")
    T_ref = read_kitti(folder / "kitti_00/ground_truth_kitti.txt")
    T_est = read_kitti(folder / "kitti_00/kiss_icp_kitti.txt")
    times = [seconds(lambda: sub_trajectory_rte(T_ref, T_est, 100.0)) for _ in range(50)]
    print(f"RTE of {len(T_ref)} poses over 100 m: {1e3 * np.median(times):.2f} ms")
    # The study's recordings are in the folder that this variable names.
    os.environ["ADAPTUNE_TEST_DATA"] = str(folder.resolve())
    with tempfile.TemporaryDirectory() as runs:
        config = Path(__file__).parent.parent / "configs/hall.yaml"
        study = load_study(
            config, [*UNCACHED, "offline.trials=32", "offline.workers=1"], Path(runs) / "hall"
        )
        trial(study)
        adaptive_replay(study, train(study).model)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
