"""How fast the simulator is, and how much memory it takes.

    python benchmarks/simulation.py
    python benchmarks/simulation.py --memory       # a course of 2 km as well

The script prints scans per second over whole courses. The simulator builds the tiles on the way,
and computes a pose for every column.
"""

import argparse
import resource
import time

from adaptune.simulation import SCENES, Course, SceneLeg
from adaptune.simulation.record import simulate


def speed(course: Course) -> tuple[int, float]:
    """Count the scans of a course but the first, and compute how many were made in a second."""
    scans = simulate(course)
    # The first scan pays for imports and compiling.
    next(scans)
    start = time.perf_counter()
    n = sum(1 for _ in scans)
    return n, n / (time.perf_counter() - start)


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--memory", action="store_true", help="drive 2 km and watch the memory")
    arguments = parser.parse_args()
    print(f"{'sensor':10}{'rays':>12}{'scene':>10}{'scans':>8}{'scans/s':>10}   wanted")
    for sensor, columns, wanted in (("hdl32e", 900, 100), ("hdl64e", 2000, 25)):
        for scene in SCENES:
            n, rate = speed(Course(scenes=(scene,), length=40.0, sensor=sensor, columns=columns))
            rays = f"{columns} x {sensor[3:5]}"
            print(f"{sensor:10}{rays:>12}{scene:>10}{n:8}{rate:10.1f}   {wanted}", flush=True)
    if arguments.memory:
        legs = tuple(SceneLeg(scene=scene, length=100.0) for scene in SCENES) * 4
        course = Course(scenes=legs[:20], sensor="vlp16", motion="car")
        print("\nresident memory along 2 km (MB)")
        for number, scan in enumerate(simulate(course)):
            if number % 400 == 0:
                peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
                print(f"{scan.T_world_sensor[0, 3]:8.0f} m  {peak:8.0f}", flush=True)


if __name__ == "__main__":
    main()
