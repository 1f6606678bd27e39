"""Scans in evalio's layout.

Points go over as raw bytes, not one Python object each. The conversion is evalio's own for
PointCloud2 messages, which is not documented: hence the pinned version.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import import_extra
from adaptune.geometry import squared_ranges
from adaptune.recording.scan import Imu, Scan

FIELDS = ("x", "y", "z", "t", "row")
"""A point as evalio reads it, four bytes each: float32 metres, uint32 nanoseconds since the scan's
stamp, uint32 laser. The laser is left out where the pipeline does not ask for it."""


class EvalioScan(NamedTuple):
    """A scan in evalio's layout; the last columns of its cloud hold bytes of uint32."""

    stamp: int
    cloud: NDArray[np.float32]  # of shape (n, 4) or (n, 5), see `FIELDS`; an image row by row
    shape: tuple[int, int]  # rows and columns
    usable: bool  # whether enough points are in range
    duration: int  # nanoseconds from the stamp to the last point; 0 if the times do not differ
    imu: Imu | None


def evalio_modules() -> tuple[Any, ...]:
    """The modules ``pipelines``, ``types`` and ``_cpp.helpers`` of evalio."""
    return import_extra("evalio", "evalio.pipelines", "evalio.types", "evalio._cpp.helpers")


@cache
def _fields() -> Any:
    """The description of `FIELDS`."""
    helpers = evalio_modules()[2]
    kinds = [helpers.DataType.FLOAT32] * 3 + [helpers.DataType.UINT32] * 2
    fields = zip(FIELDS, kinds, range(0, 20, 4), strict=True)
    return [helpers.Field(name=name, datatype=kind, offset=at) for name, kind, at in fields]


def to_evalio(prepared: EvalioScan) -> Any:
    """A prepared scan as evalio's own measurement."""
    _, types, helpers = evalio_modules()
    size, n_fields = prepared.cloud.shape
    layout = helpers.PointCloudMetadata(
        stamp=types.Stamp.from_nsec(prepared.stamp),
        width=size,
        height=1,
        point_step=4 * n_fields,
        row_step=4 * n_fields * size,
        is_bigendian=0,
        is_dense=1,
    )
    return helpers.pc2_to_evalio(layout, _fields()[:n_fields], prepared.cloud.tobytes())


def crop(scan: Scan, low: float, high: float) -> Scan:
    """The points of a scan from `low` to `high` metres away."""
    squared = squared_ranges(scan.points)
    kept = (squared >= low * low) & (squared <= high * high)
    return scan if kept.all() else scan.select(kept)


def cloud(scan: Scan, n_fields: int) -> NDArray[np.float32]:
    """Points with the first so many of `FIELDS`."""
    points = np.empty((len(scan), n_fields), np.float32)
    points[:, :3] = scan.points
    whole = points.view(np.uint32)
    # None lies before the stamp.
    whole[:, 3] = 0 if scan.times is None else np.maximum(scan.times, 0.0) * 1e9
    if n_fields > 4:
        whole[:, 4] = 0 if scan.rings is None else scan.rings
    return points


def image(scan: Scan, points: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float32]:
    """All `FIELDS` of a scan as a complete image, row by row."""
    # The seam lies behind the sensor.
    place = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    place *= columns / (2 * np.pi)
    place += columns / 2
    # Firings that fall on the borders between columns would share every other one.
    place -= np.angle(np.exp(2j * np.pi * place[::16]).mean()) / (2 * np.pi)
    column = np.rint(place).astype(np.int64) % columns
    # Rays that did not come back lie at the origin, where every pipeline drops them.
    pixels = np.zeros((rows * columns, 5), np.float32)
    row = pixels.view(np.uint32)[:, 4]
    row[:] = np.repeat(np.arange(rows, dtype=np.uint32), columns)
    pixels[points.view(np.uint32)[:, 4] * np.int64(columns) + column] = points
    return pixels
