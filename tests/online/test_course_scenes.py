import numpy as np
import pytest

from adaptune.trajectory import Trajectory
from online.replayed import scene_spans

LEGS = [("cave", 20.0), ("open", 30.0), ("street", 10.0)]
START = 1_600_000_000_000_000_000


def drive(stretched=1.0):
    """Two metres a second in the cave, then three; the path may be longer than the road."""
    seconds = np.linspace(0.0, 10.0 + 40.0 / 3.0, 2000)
    x = np.where(seconds < 10.0, 2.0 * seconds, 20.0 + 3.0 * (seconds - 10.0))
    T = np.tile(np.eye(4), (len(x), 1, 1))
    T[:, 0, 3] = stretched * x
    return Trajectory(START + np.rint(seconds * 1e9).astype(np.int64), T)


@pytest.mark.parametrize("stretched", [1.0, 1.1])
def test_metres_of_the_road_become_seconds(stretched):
    driven = drive(stretched)
    spans = scene_spans(LEGS, driven, driven.stamps)
    assert spans.names == ("cave", "open", "street")
    np.testing.assert_allclose(spans.edges, [0.0, 10.0, 20.0, 70.0 / 3.0], atol=0.02)


def test_of_a_part_its_own_scenes_are_shown():
    driven = drive()
    part = driven.stamps[(driven.stamps >= START + 15e9) & (driven.stamps <= START + 21e9)]
    spans = scene_spans(LEGS, driven, part)
    assert spans.names == ("open", "street")
    np.testing.assert_allclose(spans.edges, [0.0, 5.0, 6.0], atol=0.03)
