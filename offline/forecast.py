"""How long a study will take, as the baseline's drives tell."""

from typing import NamedTuple

import numpy as np

from adaptune.archive import Archive
from adaptune.progress import about
from offline.campaign import read_whole_drives
from offline.choice import DEARER, FINALISTS
from offline.config import OfflineStudy
from offline.search import Clock

COST = 1.4
"""Of a set, over the baseline's, about: 1.1 to 1.6 in the mean of the sets on each of five
recordings."""
ALONE = 3
"""Replays of one set: the baseline, the fixed set, and its rival."""
FITTING = 10.0
"""Seconds to fit the model, to compare, and to draw the page, about."""


class Forecast(NamedTuple):
    """Seconds, where all workers are at work."""

    each: float  # to try a set on all training sequences
    rest: float  # of what follows: finalists' drives of whole recordings, and the replays

    def words(self, left: float, most: float) -> str:
        """How long it takes to try so many sets and to finish, in at most so many seconds."""
        n, whole = left, self.each * left + self.rest
        if whole > most:
            n, whole = max(0.0, (most - self.rest) / max(self.each, 1e-9)), most
        return f"it takes {about(whole)}: {n:.0f} parameter sets of {self.each:.1f} s, and the rest"


def forecast(study: OfflineStudy, archive: Archive, workers: int, clock: Clock) -> Forecast:
    """Tell from the baseline's drives how long the search takes, and what follows it.

    Replays count if they do for the clock.
    """
    baselines = range(len(study.odometry.space.baselines))
    drives = read_whole_drives(archive, study.training, baselines)
    costs, each, rest = [], 0.0, 0.0
    for name, runs in drives.items():
        frames = archive.read_frames(name)
        known = [run.ms if np.isnan(run.cost) else run.cost for run in runs.values()]
        costs.append(1e-3 * float(np.mean(known)))
        each += COST * costs[-1] * frames.n_driven * study.config.offline.repeats
        if not archive.is_uncut(name):
            rest += COST * costs[-1] * len(frames.stamps) * (FINALISTS + DEARER)
    workers = max(workers, 1)  # those of a cluster may come later
    rest = FITTING + rest / workers
    if clock.replays:
        members = study.config.online.switching.size if study.mechanism == "bank" else 0
        scans = sum(study.sequences.open(name).n_messages for name in study.config.test)
        rest += float(np.mean(costs)) * scans * (ALONE + len(study.rules) * (members + 1))
    return Forecast(each / workers, rest)
