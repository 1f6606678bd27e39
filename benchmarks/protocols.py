"""The studies of published tables, run from end to end on stand-ins of their data.

    python benchmarks/protocols.py {kitti,drives,garden,docker} FOLDER [--sets N] [--data-only]

*kitti* makes a folder of the KITTI odometry benchmark from eleven simulated drives of a car, and
runs configs/kitti_gicp.yaml on it. *drives* does the same with parts of three recorded drives of
KITTI's car: ADAPTUNE_TEST_DATA names the folder of town.bag, road.bag and city.bag. *garden*
simulates seven bags with the names of BotanicGarden's, and runs configs/botanic_garden_gicp.yaml
with four samplers, each in a folder of its own. *docker* runs configs/garden_docker.yaml with three
samplers: it needs the reference image (make reference-image), whose bags play in real time.

The studies are those that users run, with fewer sets and shorter sub-trajectories (`-o`). Each
command is printed before it runs. The same command resumes.
"""

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from adaptune.geometry import Poses, invert
from adaptune.recording.compensation import compensate
from adaptune.recording.config import SequenceConfig, read_part
from adaptune.recording.export import write_kitti_sequence
from adaptune.recording.folder import ELEVATION, turn_up
from adaptune.recording.recording import open_sequence
from adaptune.recording.scan import Scan
from adaptune.simulation import Course
from adaptune.simulation.record import SimulatedDrive, SimulatedScan, record

CONFIGS = Path(__file__).parents[1] / "configs"

# A car on the streets, the country roads and the motorway of KITTI's eleven sequences.
ROADS = {
    "00": ["street"],
    "01": ["open"],
    "02": ["street", "garden"],
    "03": ["garden"],
    "04": ["street"],
    "05": ["street", "open"],
    "06": ["street"],
    "07": ["garden", "street"],
    "08": ["open", "street"],
    "09": ["garden"],
    "10": ["open", "garden"],
}
# Parts of the recorded drives, of 37 m at least: the beginning of each is trained on.
PARTS = {
    "00": ("road", "0-25%"),
    "01": ("road", "25-45%"),
    "02": ("road", "45-65%"),
    "03": ("town", "0-25%"),
    "04": ("town", "25-40%"),
    "05": ("city", "0-40%"),
    "06": ("road", "65-83%"),
    "07": ("road", "83-100%"),
    "08": ("town", "40-70%"),
    "09": ("town", "70-100%"),
    "10": ("city", "40-100%"),
}

GARDENS = ("1005_00", "1005_01", "1005_07", "1006_01", "1008_03", "1018_00", "1018_13")


def courses(metres: float) -> dict[str, Course]:
    """The drives of the simulated KITTI, by the names of the sequences."""
    return {
        name: Course(
            scenes=tuple(scenes),
            length=metres / len(scenes),
            sensor="hdl64e",
            motion="car",
            seed=int(name) + 1,
        )
        for name, scenes in ROADS.items()
    }


def simulate_kitti(root: Path, metres: float = 150.0) -> None:
    """Eleven short sequences; their rays are too low, as those of KITTI's LiDAR."""
    for name, course in courses(metres).items():
        drive = SimulatedDrive(course)
        scans = ((standing(drive, scan), scan.T_world_sensor) for scan in drive.scans())
        lowered = ((replace(scan, points=turn_up(scan.points, -ELEVATION)), T) for scan, T in scans)
        write_sequence(root, name, lowered)


def standing(drive: SimulatedDrive, scan: SimulatedScan) -> Scan:
    """A scan as KITTI has it: undistorted to the scan's start, intensities from 0 to 1."""
    assert scan.times is not None
    times, column = np.unique(scan.times, return_inverse=True)
    T_world_column = drive.ride.poses((scan.stamp - drive.stamps()[0]) * 1e-9 + times.astype(float))
    T = (invert(scan.T_world_sensor) @ T_world_column)[column]
    points = np.einsum("nij,nj->ni", T[:, :3, :3], scan.points) + T[:, :3, 3]
    light = scan.intensities / np.float32(255.0)
    return Scan(scan.stamp, points.astype(np.float32), intensities=light)


def convert_drives(root: Path) -> None:
    """Parts of the recorded drives, undistorted by the car's own poses, as KITTI's clouds are."""
    for name, (drive, part) in PARTS.items():
        bag = str(Path(os.environ["ADAPTUNE_TEST_DATA"]) / f"{drive}.bag")
        config = SequenceConfig(
            bag=bag, points="/velodyne_points", reference="/gt_poses", part=read_part(part)
        )
        write_sequence(root, name, undistorted(config))


def undistorted(config: SequenceConfig) -> Iterator[tuple[Scan, Poses]]:
    """Scans as seen from where they start, with their poses, as far as the reference is known."""
    sequence = open_sequence(config)
    reference = sequence.reference()
    assert reference is not None
    for scan in sequence:
        T_world_start, T_world_end = reference.at(np.array([scan.stamp, scan.stamp + 10**8]))
        if np.isfinite([T_world_start, T_world_end]).all():
            yield compensate(scan, invert(T_world_start) @ T_world_end, 0.1), T_world_start


def write_sequence(root: Path, name: str, scans: Iterable[tuple[Scan, Poses]]) -> None:
    """Write a sequence of the KITTI odometry benchmark with its poses, unless it is there."""
    if (root / "sequences" / name).exists():
        return
    T_world_lidar: list[Poses] = []

    def seen() -> Iterator[Scan]:
        for scan, T in scans:
            T_world_lidar.append(T)
            yield scan

    for kind in ("sequences", "poses"):
        (root / kind).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".making.", dir=root) as made:
        new = Path(made)
        write_kitti_sequence(seen(), new, name)
        T = invert(T_world_lidar[0]) @ np.array(T_world_lidar)
        (new / "poses").mkdir()
        np.savetxt(new / "poses" / f"{name}.txt", T[:, :3].reshape(-1, 12), fmt="%.9e")
        # The scans last: a sequence that is there has its poses.
        for file in (f"poses/{name}.txt", f"sequences/{name}"):
            (new / file).rename(root / file)
    print(f"{root}: sequence {name}, {len(T_world_lidar)} scans", flush=True)


def simulate_gardens(root: Path, metres: float = 80.0) -> None:
    """Bags with the topics, the stamps and the names of BotanicGarden's."""
    root.mkdir(parents=True, exist_ok=True)
    for number, name in enumerate(GARDENS):
        if not (bag := root / f"{name}.bag").exists():
            scenes, seed = ("garden",), 300 + number
            record(
                Course(
                    scenes=scenes, length=metres, sensor="vlp16", imu=400, stamp="end", seed=seed
                ),
                bag,
            )
            print(bag, flush=True)


@dataclass(frozen=True)
class Protocol:
    """A study, what stands in for its data, and how it differs from what its users run."""

    study: str
    variable: str = ""  # names the folder of the data
    make: Callable[[Path], None] = lambda _: None
    overrides: tuple[str, ...] = ()
    # By the names of their folders, the overrides of the variants that are compared.
    variants: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: {"": ()})
    simulated: bool = False  # whether the study simulates its data itself
    sets: int = 32  # of each search


def samplers(grid: str) -> dict[str, tuple[str, ...]]:
    """The searches of the thesis, as overrides: grid, random, and annealing from the baseline."""
    walk = "offline.sampler_settings={chains: 1, energy_scale: 1.0, initial_temperature: 1.0}"
    return {
        "grid": ("offline.sampler=grid", f"offline.sampler_settings={{grid: {grid}}}"),
        "random": ("offline.sampler=random", "offline.sampler_settings={}"),
        "annealing": (
            *("offline.sampler=annealing", walk, "offline.initial=1", "offline.batch=1"),
        ),
    }


# Numbers of the grids: 30 points for 32 sets, 18 for 19.
GICP_GRID = (
    "{max_correspondence_distance: {low: 0.5, high: 10.0, count: 5}, "
    "keyframe_interval: {low: 0.5, high: 30.0, count: 6}}"
)
DOCKER_GRID = (
    "{gicp/max_correspondence_distance: {low: 1.0, high: 10.0, count: 3}, "
    "gicp/keyframe_interval: {low: 1.0, high: 30.0, count: 3}, "
    "gicp/downsampling: {low: 0.2, high: 1.0, count: 2}}"
)
SHORT = ("sub_trajectory=25.0", "offline.initial=16")
GARDEN = ("sub_trajectory=10.0", "offline.objective=rpe", "offline.initial=16")

PROTOCOLS = MappingProxyType(
    {
        "kitti": Protocol("kitti_gicp", "KITTI", simulate_kitti, SHORT),
        # A pair of the city's poses is off by 0.5 m: no odometry lost its track there.
        "drives": Protocol("kitti_gicp", "KITTI", convert_drives, (*SHORT, "lost_track=10.0")),
        "garden": Protocol(
            "botanic_garden_gicp",
            "BOTANIC_GARDEN",
            simulate_gardens,
            GARDEN,
            {"tpe": (), **samplers(GICP_GRID)},
        ),
        "docker": Protocol(
            "garden_docker",
            overrides=("offline.objective=rpe", "offline.segments=all"),
            variants=samplers(DOCKER_GRID),
            simulated=True,
            sets=19,
        ),
    }
)


def commands(name: str, folder: Path, n_sets: int) -> list[list[str]]:
    """The commands of a protocol, as a user would write them; each variant has a folder."""
    protocol = PROTOCOLS[name]
    study = str(CONFIGS / f"{protocol.study}.yaml")
    stages = ("simulate", "offline", "online") if protocol.simulated else ("offline", "online")
    made: list[list[str]] = []
    for variant, own in protocol.variants.items():
        own_folder = str(folder / "runs" / "-".join(filter(None, (name, variant))))
        given = [f"offline.trials={n_sets}", *protocol.overrides, *own]
        options = ["--folder", own_folder, *(word for key in given for word in ("-o", key))]
        made += [["adaptune", stage, study, *options] for stage in (*stages, "compare")]
    return made


def main() -> None:
    """Make the data, and run the commands."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("protocol", choices=PROTOCOLS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--sets", type=int, help="parameter sets of a search")
    parser.add_argument("--data-only", action="store_true")
    given = parser.parse_args()
    if given.protocol == "drives" and "ADAPTUNE_TEST_DATA" not in os.environ:
        sys.exit("ADAPTUNE_TEST_DATA does not name the folder of the recordings")
    protocol, data = PROTOCOLS[given.protocol], (given.folder / given.protocol).resolve()
    protocol.make(data)
    variable = {protocol.variable: str(data)} if protocol.variable else {}
    n_sets = given.sets or protocol.sets
    for words in [] if given.data_only else commands(given.protocol, given.folder, n_sets):
        print(*(f"{key}={value}" for key, value in variable.items()), shlex.join(words), flush=True)
        subprocess.run([sys.executable, "-m", *words], check=True, env=os.environ | variable)


if __name__ == "__main__":
    main()
