"""Trials without a campaign: sets that are driven here and now."""

import numpy as np

from offline.drive import drive_sets, trial_of
from offline.frames import describe, segments_along
from offline.shared_scans import SharedScans
from offline.workers import Task


def described(setup, name="one"):
    """The frames of a sequence."""
    return describe(setup.config, setup.sequences, name)


def trials_of(setup, sets, name="one", frames=None, scans=None, most=np.inf, memory=1e9):
    """Drive sets along the segments of a sequence, and make trials of that."""
    frames = described(setup, name) if frames is None else frames
    scans = setup.sequences.open(name) if scans is None else scans
    shared, found = SharedScans(memory), [{} for _ in sets]
    for segment in segments_along(name, frames):
        drives = drive_sets(setup, shared, scans, segment, sets, most)
        for of_set, drive in zip(found, drives, strict=True):
            of_set[segment.first] = drive
    pairs = zip(sets, found, strict=True)
    return [trial_of(setup.config, one, frames, of_set) for one, of_set in pairs]


def task_of(setup, name, sets):
    """A task that drives sets along a whole sequence."""
    (segment,) = segments_along(name, described(setup, name).uncut)
    return Task(name, segment=segment, sets=sets)


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
