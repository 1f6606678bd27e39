"""Error models of random numbers."""

import numpy as np

from adaptune.model import ErrorModel
from adaptune.space import Categorical, Float, Integer, ParameterSets, ParameterSpace

SPACE = ParameterSpace(
    {
        "distance": Float(low=1.0, high=10.0, baseline=4.0, log=True),
        "points": Integer(low=1, high=50, baseline=20),
        "kernel": Categorical(choices=("none", 1, True), baseline="none"),
    }
)


TRIALS = (0, 2, 4, 6, 8, 10)


def random_model(seed=0, n_frames=50, n_sets=6):
    rng = np.random.default_rng(seed)
    errors = rng.gamma(1.0, 2.0, (n_frames, n_sets)).astype(np.float32)
    errors[rng.random(errors.shape) < 0.05] = np.inf
    return ErrorModel(
        odometry={"name": "gicp", "settings": {"downsampling": 0.1 + 0.2}},
        sets=ParameterSets(SPACE, TRIALS[:n_sets], tuple(SPACE.from_unit(rng.random((n_sets, 3))))),
        fixed=4,
        length=25.0,
        sequences=["cave", "Straße"],
        blocks={"ndt": 90},
        window=1,
        descriptors=rng.integers(0, 500, (n_frames, 90)).astype(np.float32),
        sequence=rng.integers(0, 2, n_frames),
        errors=errors,
        bank=[4, 10],
        vectors=rng.normal(0.0, 1.0, (n_frames, 2, 3)).astype(np.float32),
        provenance={"seed": n_sets, "note": None},
        elevations=[-30.7, -15.0],
    )
