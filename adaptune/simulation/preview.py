"""A picture of a simulated recording."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from adaptune.drawing import colour_map, picture, plain
from adaptune.simulation.simulate import Drive, SimulatedScan

_MAP_SCANS, _MAP_POINTS = 150, 4000
"""Number of scans in the map, and points of each."""


class Preview:
    """Collects the content of the picture of a drive scan by scan."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._every = max(len(drive) // _MAP_SCANS, 1)
        self._shown = len(drive) // 2
        self._count = 0
        self._map: list[NDArray[np.float64]] = []
        self._scan: SimulatedScan | None = None

    def add(self, scan: SimulatedScan) -> None:
        """Add the next scan."""
        if self._count % self._every == 0 and len(scan):
            T = scan.T_world_sensor
            points = scan.points[:: max(len(scan) // _MAP_POINTS, 1)]
            near = points[np.linalg.norm(points[:, :2], axis=1) < 45.0]
            # Height above the sensor, in its own upright frame.
            self._map.append(np.column_stack([near @ T[:2, :3].T + T[:2, 3], near @ T[2, :3]]))
        if self._count == self._shown:
            self._scan = scan
        self._count += 1

    def save(self, files: Iterable[Path]) -> None:
        """Draw the map with the path, and the middle scan from above and as a panorama.

        Parameters
        ----------
        files
            See `adaptune.drawing.picture`.
        """
        course = self._drive.course
        with picture(files, 16.0, 9.0) as figure:
            upper: Any = ["map", "map", "scan"]
            panels = figure.subplot_mosaic([upper, upper, ["panorama"] * 3])
            figure.suptitle(
                f"{' - '.join(name for name, _ in course.legs)}, {course.sensor}, {course.motion}, "
                f"seed {course.seed}: {len(self._drive)} scans, {self._drive.road.length:.0f} m"
            )
            self._draw_map(figure, panels["map"])
            if self._scan is not None and len(self._scan):
                _draw_scan(figure, panels["scan"], panels["panorama"], self._scan.points)

    def _draw_map(self, figure: Any, axes: Any) -> None:
        points = np.concatenate(self._map) if self._map else np.empty((0, 3))
        x, y, z = points[np.argsort(points[:, 2], kind="stable")].T
        dots = axes.scatter(x, y, c=z, s=0.5, vmin=-1.5, vmax=4.0, **_look())
        T = self._drive.ride.poses(np.linspace(0.0, self._drive.ride.duration, 2000))
        axes.plot(T[:, 0, 3], T[:, 1, 3], color="#d55e00", lw=2.0, label="path")
        axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title="the recording from above")
        label = "height above the sensor [m]"
        figure.colorbar(dots, ax=axes, label=label, pad=0.01, extend="both")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0))


def _look() -> dict[str, Any]:
    """Dots of a cloud: a picture in an SVG, too, which thousands of shapes would make slow."""
    return {"linewidths": 0, "cmap": colour_map(), "rasterized": True}


def _draw_scan(figure: Any, above: Any, panorama: Any, points: NDArray[np.float32]) -> None:
    away = np.linalg.norm(points, axis=1)
    look = _look() | {"c": away, "norm": LogNorm(1.0, 80.0)}
    above.scatter(points[:, 0], points[:, 1], s=0.6, **look)
    span = np.percentile(np.abs(points[:, :2]).max(axis=1), 97)
    above.set(aspect="equal", xlim=(-span, span), ylim=(-span, span))
    above.set(title="one scan from above", xlabel="x [m]", ylabel="y [m]")
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    elevation = np.degrees(np.arcsin(points[:, 2] / away))
    dots = panorama.scatter(azimuth, elevation, s=9.0, marker="s", **look)
    panorama.set(xlim=(180, -180), xlabel="azimuth [deg]", ylabel="elevation [deg]")
    panorama.set_title("the same scan as the sensor sees it")
    ticks = {"ticks": [1, 2, 5, 10, 20, 50], "format": plain}
    bar = figure.colorbar(dots, ax=[above, panorama], label="range [m]", pad=0.01, **ticks)
    bar.ax.minorticks_off()
