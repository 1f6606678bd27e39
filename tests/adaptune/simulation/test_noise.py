import numpy as np

from adaptune.simulation.mesh import fractal

RNG = np.random.default_rng(0)


def test_noise_is_bounded_smooth_and_centred():
    points = RNG.uniform(-1e3, 1e3, (20_000, 3))
    values = fractal(points, 3.0, seed=5)
    assert np.abs(values).max() <= 1.0
    assert abs(values.mean()) < 0.02
    assert values.std() > 0.2
    assert np.abs(fractal(points + 1e-4, 3.0, seed=5) - values).max() < 1e-3


def test_noise_depends_on_place_and_seed_alone():
    points = RNG.uniform(-50.0, 50.0, (100, 3))
    whole = fractal(points, 2.0, seed=1, octaves=3)
    np.testing.assert_array_equal(fractal(points[40:60], 2.0, seed=1, octaves=3), whole[40:60])
    assert np.abs(fractal(points, 2.0, seed=2, octaves=3) - whole).max() > 0.1
