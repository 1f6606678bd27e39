"""Trials without a campaign: sets that are driven here and now."""

import numpy as np

from offline.trial import SharedScans, stretches_along, trial_of
from offline.workers import Task


def trials_of(setup, sets, name="one", frames=None, scans=None, most=np.inf, memory=1e9):
    """Drive sets along the stretches of a sequence, and make trials of that."""
    frames = setup.describe(name) if frames is None else frames
    scans = setup.sequences.open(name) if scans is None else scans
    shared, found = SharedScans(memory), [{} for _ in sets]
    for stretch in stretches_along(name, frames):
        drives = setup.drive(shared, scans, stretch, sets, most)
        for of_set, drive in zip(found, drives, strict=True):
            of_set[stretch.first] = drive
    pairs = zip(sets, found, strict=True)
    return [trial_of(setup.settings, one, frames, of_set) for one, of_set in pairs]


def task_of(setup, name, sets):
    """A task that drives sets along a whole sequence."""
    (stretch,) = stretches_along(name, setup.describe(name).uncut)
    return Task(name, stretch=stretch, sets=sets)


class Tasks:
    """Work for a pool that does not grow."""

    def __init__(self, *tasks):
        self.tasks, self.noted = list(tasks), []

    def waits(self):
        return bool(self.tasks)

    def take(self, *_):
        return self.tasks.pop(0)

    def note(self, _task, progress):
        self.noted.append(progress)
