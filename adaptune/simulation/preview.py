"""A picture of a simulated recording."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

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

    def save(self, path: Path) -> None:
        """Draw the map with the path, and the middle scan from above and as a panorama."""
        figure = Figure(figsize=(16.0, 9.0), dpi=110, layout="constrained")
        upper: Any = ["map", "map", "scan"]
        panels = figure.subplot_mosaic([upper, upper, ["panorama"] * 3])
        course = self._drive.course
        figure.suptitle(
            f"{' - '.join(name for name, _ in course.legs)}, {course.sensor}, {course.motion}, "
            f"seed {course.seed}: {len(self._drive)} scans, {self._drive.road.length:.0f} m"
        )
        self._draw_map(panels["map"])
        if self._scan is not None and len(self._scan):
            points = self._scan.points
            away = np.linalg.norm(points, axis=1)
            look = {"c": away, "cmap": "turbo_r", "norm": LogNorm(1.0, 80.0)}
            panel = panels["scan"]
            panel.scatter(points[:, 0], points[:, 1], s=0.4, linewidths=0, **look)
            span = np.percentile(np.abs(points[:, :2]).max(axis=1), 97)
            panel.set(aspect="equal", xlim=(-span, span), ylim=(-span, span), facecolor="black")
            panel.set(title="one scan from above, by range", xlabel="m")
            panel = panels["panorama"]
            azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
            elevation = np.degrees(np.arcsin(points[:, 2] / away))
            drawn = panel.scatter(azimuth, elevation, s=9.0, marker="s", linewidths=0, **look)
            panel.set(xlim=(180, -180), facecolor="black", xlabel="azimuth (deg)")
            panel.set(ylabel="elevation (deg)", title="the same scan as the sensor sees it")
            figure.colorbar(drawn, ax=panel, label="range (m)", pad=0.01)
        figure.savefig(path, format="png")

    def _draw_map(self, axes: Any) -> None:
        points = np.concatenate(self._map) if self._map else np.empty((0, 3))
        points = points[np.argsort(points[:, 2], kind="stable")]
        x, y, z = points.T
        axes.scatter(x, y, c=z, s=0.5, linewidths=0, cmap="viridis", vmin=-1.5, vmax=4.0)
        T = self._drive.ride.poses(np.linspace(0.0, self._drive.ride.duration, 2000))
        axes.plot(T[:, 0, 3], T[:, 1, 3], color="red", linewidth=1.2)
        axes.set(aspect="equal", facecolor="black", xlabel="x (m)", ylabel="y (m)")
        axes.set_title("from above, by height, with the path")
