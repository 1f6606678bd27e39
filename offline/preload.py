"""Loads what takes long and what almost every worker needs; the workers' server imports it."""

import numpy as np

# The workers start from this module's imports.
import offline.trial  # noqa: F401
from adaptune.descriptor.ndt_histogram import ndt_histogram

# The first call loads the compiled function.
ndt_histogram(np.zeros((0, 3), np.float32))
