import numpy as np
import pytest

from adaptune.simulation.scenes import SCENES
from adaptune.simulation.world import APRON, Road


@pytest.fixture(scope="module")
def road():
    return Road([(SCENES[n], 40.0) for n in ("cave", "street", "garden", "open")], seed=3)


def test_stations_and_coordinates_are_inverse(road):
    s = np.linspace(-APRON, road.length + APRON, 500)
    x, _ = road.plane(s, np.zeros_like(s))
    assert np.all(np.diff(x) > 0.0)
    np.testing.assert_allclose(road.station(x), s, atol=1e-9)


def test_scenes_share_the_ground_without_a_step(road):
    s = np.linspace(-30.0, 190.0, 4401)
    np.testing.assert_allclose(sum(share for _, share in road.shares(s)), 1.0)
    for d in (0.0, 8.0, -20.0):
        z = road.ground(*road.plane(s, np.full_like(s, d)))
        # A kerb and a river bank are steep; a step would be more.
        assert np.abs(np.diff(z)).max() < 0.2, d
