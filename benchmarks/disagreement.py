"""What makes places disagree about parameters: how many scans a second, and how dense they are.

    python benchmarks/disagreement.py [--seeds 131 132] [--scene-length 40]

Sets of GICP drive along the same simulated courses, once with all scans and once with every fifth,
with a dense sensor and with a sparse one. A line is a set: its error over 5 m to that of the
odometry's own parameters in each scene, the geometric mean over the seeds and the worst of them.
"""

import argparse

import numpy as np

from adaptune.metrics import cap, sub_trajectory_rte, travelled
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.health import HealthCheck
from adaptune.odometry.registry import odometry_class
from adaptune.odometry.remote import Limits
from adaptune.odometry.tracker import Tracker
from adaptune.simulation import Course
from adaptune.simulation.record import SimulatedScan, simulate

SCENES = ("mine", "street", "open", "garden")
SENSORS = {"HDL-32E": {}, "VLP-16, a sixth of its columns": {"sensor": "vlp16", "columns": 300}}
SETS = {  # correspondence distance, keyframe interval and distance of points in metres
    "own parameters": (4.0, 4.0, 0.5),
    "short correspondences": (1.3, 4.0, 0.5),
    "short and dense": (1.1, 4.4, 0.25),
    "dense": (4.0, 4.0, 0.25),
}
LENGTH = 5.0


def errors(scans: list[SimulatedScan], set_: tuple[float, ...], scene_length: float) -> list[float]:
    """Mean clipped errors of a set in each scene, in percent."""
    space = odometry_class("gicp").space
    names = ("max_correspondence_distance", "keyframe_interval", "downsampling")
    parameters = {**dict(zip(names, set_, strict=True)), "iterations": 20}
    odometry = OdometryFactory("gicp", {}, space, Limits())(parameters)
    tracker = Tracker(odometry, HealthCheck(max_speed=8.0))
    T_odom_sensor = np.array([tracker.register(scan).T_odom_sensor for scan in scans])
    odometry.close()
    T_ref_sensor = np.array([scan.T_world_sensor for scan in scans])
    rte = cap(sub_trajectory_rte(T_ref_sensor, T_odom_sensor, LENGTH))
    scene = np.minimum(travelled(T_ref_sensor) // scene_length, len(SCENES) - 1)
    return [float(np.nanmean(rte[scene == i])) for i in range(len(SCENES))]


def main() -> None:
    """Drive, and print a table for each sensor and stride."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[131, 132])
    parser.add_argument("--scene-length", type=float, default=40.0)
    given = parser.parse_args()
    for sensor, keys in SENSORS.items():
        courses = [
            Course(scenes=SCENES, length=given.scene_length, motion="agile", seed=seed, **keys)
            for seed in given.seeds
        ]
        drives = [list(simulate(course)) for course in courses]
        for stride in (1, 5):
            found = {
                name: np.array([errors(d[::stride], set_, given.scene_length) for d in drives])
                for name, set_ in SETS.items()
            }
            own = found["own parameters"]
            mean = "  ".join(
                f"{s} {e:.2f} %" for s, e in zip(SCENES, own.mean(axis=0), strict=True)
            )
            print(f"{sensor}, {10 / stride:g} scans a second: own parameters {mean}")
            for name, errors_ in found.items():
                logs = np.log(errors_ / own)
                cells = (
                    f"{s} {r:.2f} ({w:.2f})"
                    for s, r, w in zip(
                        SCENES, np.exp(logs.mean(axis=0)), np.exp(logs.max(axis=0)), strict=True
                    )
                )
                print(f"  {name:22}", "  ".join(cells), flush=True)


if __name__ == "__main__":
    main()
