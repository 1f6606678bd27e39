"""Where on a recording of a simulated course which scene is."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from adaptune.charts.chart import Spans
from adaptune.metrics import travelled
from adaptune.trajectory import Trajectory


def scene_spans(
    legs: Sequence[tuple[str, float]], driven: Trajectory, stamps: NDArray[np.int64]
) -> Spans:
    """The scenes of a drive, as stretches of its time.

    Metres of the road become time by the path that was driven. It is a little longer than the road,
    because the vehicle strays and shakes: it is scaled to the road's length.

    Parameters
    ----------
    legs
        Name and metres of each scene, in driving order.
    driven
        True poses of the whole drive.
    stamps
        Of the scans that are shown, nanoseconds: they may be a part of the drive. Edges are seconds
        since the first of them.
    """
    along = travelled(driven.T_world_sensor)
    names, metres = zip(*legs, strict=True)
    ends = np.cumsum([0.0, *metres])
    path = along / max(float(along[-1]), 1e-9) * ends[-1]
    seconds = (driven.stamps - stamps[0]) * 1e-9
    edges = np.interp(ends, path, seconds)
    edges[-1] = max(edges[-1], seconds[-1])
    begin, end = 0.0, float(stamps[-1] - stamps[0]) * 1e-9
    shown = [i for i in range(len(names)) if edges[i] < end and edges[i + 1] > begin]
    kept = np.clip(edges[[*shown, shown[-1] + 1]], begin, end)
    return Spans(kept, tuple(names[i] for i in shown))
