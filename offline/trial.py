"""A trial: one parameter set with all its drives on a recording."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune.archive import FIRST_POSE, PREPARE_MS, REGISTER_MS, Frames, Trial
from adaptune.metrics import cap, sub_trajectory_rte
from adaptune.odometry.faults import MAX_SHARE_WITHOUT_POSE, MOST_FAULTS
from adaptune.space import ParameterSet
from offline.config import OfflineStudyConfig
from offline.drive import Drive
from offline.objective import trajectory_metrics
from offline.stretches import stretches_along


def trial_of(
    config: OfflineStudyConfig,
    parameters: ParameterSet,
    frames: Frames,
    drives: Mapping[int, Sequence[Drive]],
) -> Trial:
    """Make a trial of the drives along all stretches of a sequence, by the first scan of each.

    There is one for every repeat. Stretches along which a set was not driven count as lost.
    """
    lost = {stretch.first: Drive.lost(stretch) for stretch in stretches_along("", frames)}
    repeats = [
        [drives[first][i] if first in drives else none for first, none in lost.items()]
        for i in range(min(map(len, drives.values())))
    ]
    return _mean([_trial(config, parameters, frames, of_repeat) for of_repeat in repeats])


def _trial(
    config: OfflineStudyConfig, parameters: ParameterSet, frames: Frames, drives: Sequence[Drive]
) -> Trial:
    at = np.concatenate([np.arange(first, end) for first, _, end in frames.stretches])
    late, seconds = [], 0.0
    for drive, (first, _, end) in zip(drives, frames.stretches, strict=True):
        late.append(int(np.argmax([*drive.registered, True])))
        seconds += (frames.stamps[end - 1] - frames.stamps[first]) * 1e-9

    def joined(parts: Iterable[NDArray[Any]], elsewhere: float) -> NDArray[Any]:
        driven = np.concatenate(list(parts))
        whole = np.full((len(frames.stamps), *driven.shape[1:]), elsewhere, driven.dtype)
        whole[at] = driven
        return whole

    T_odom_sensor = joined((drive.T_odom_sensor for drive in drives), np.nan)
    registered = joined((drive.registered for drive in drives), 0)
    tried = joined((drive.tried for drive in drives), 0)
    without_pose = joined((drive.without_pose for drive in drives), 0)
    # Scans before a first pose that comes are unknown.
    before = (np.arange(n := len(d.tried)) < k % n for d, k in zip(drives, late, strict=True))
    waiting = joined(before, 0)
    T_ref_sensor, failure, lost = frames.counted, "", int(without_pose.sum())
    missing = int((waiting | without_pose).sum())
    if missing >= MAX_SHARE_WITHOUT_POSE * frames.n_driven:
        failure, lost = f"no pose for {missing} of {frames.n_driven} scans", missing
    else:
        T_ref_sensor[waiting & ~without_pose] = np.nan
    unhealthy = dict(sum((drive.unhealthy for drive in drives), Counter[str]()))
    faults = [fault for drive in drives for fault in drive.faults]
    faults += dict.fromkeys(drive.exception for drive in drives if drive.exception)
    if len(faults) >= MOST_FAULTS:
        failure = f"{len(faults)} faults"
    used = _used(drives, seconds)
    if slow := any(drive.too_slow for drive in drives):
        failure = f"too slow: {used[REGISTER_MS]:.0f} ms a scan"
    # What goes on without poses may seem to do well; where a slow set is stopped is chance.
    unseen = ~tried | slow | ((without_pose | waiting) & bool(failure))
    errors = sub_trajectory_rte(T_ref_sensor, T_odom_sensor, config.sub_trajectory, unseen)
    if np.isnan(errors).all():
        failure = failure or "no sub-trajectory has poses"
    if 0 < late[0] < len(drives[0].tried):
        stamps = frames.stamps[frames.stretches[0, 0] :]
        used[FIRST_POSE] = float(stamps[late[0]] - stamps[0]) * 1e-9
    return Trial(
        parameters,
        T_odom_sensor,
        errors,
        joined((drive.restarted for drive in drives), 0),
        registered,
        joined((drive.seconds for drive in drives), np.nan),
        tuple(faults),
        trajectory_metrics(T_ref_sensor, T_odom_sensor),
        used,
        unhealthy=unhealthy | ({"no_pose": lost} if lost else {}),
        failure=failure,
    )


def _used(drives: Sequence[Drive], seconds: float) -> dict[str, float]:
    """CPU time and memory of drives along so many seconds, see `Trial.usage`."""
    cpu = sum(drive.usage.cpu for drive in drives)
    n_tried = [int(drive.tried.sum()) for drive in drives]
    prepare_ms = sum(drive.prepare_ms * n for drive, n in zip(drives, n_tried, strict=True))
    n = max(sum(n_tried), 1)
    used = {"cpu": 100.0 * cpu / seconds, REGISTER_MS: 1e3 * cpu / n, PREPARE_MS: prepare_ms / n}
    memory = [drive.usage.memory for drive in drives if drive.usage.memory is not None]
    return used | ({"memory": max(memory)} if memory else {})


def _mean(repeats: Sequence[Trial]) -> Trial:
    """One trial of several with the same parameters."""
    if len(repeats) == 1:
        return repeats[0]
    metrics = set.intersection(*(set(trial.metrics) for trial in repeats))
    usage = {m: None for trial in repeats for m in trial.usage}
    return replace(
        repeats[0],
        errors=np.mean([cap(trial.errors) for trial in repeats], axis=0),
        restarted=np.mean([trial.restarted for trial in repeats], axis=0),
        registered=np.all([trial.registered for trial in repeats], axis=0),
        seconds=np.mean([trial.seconds for trial in repeats], axis=0),
        faults=tuple(fault for trial in repeats for fault in trial.faults),
        metrics={m: float(np.mean([t.metrics[m] for t in repeats])) for m in sorted(metrics)},
        usage={m: float(np.mean([t.usage.get(m, 0.0) for t in repeats])) for m in usage},
        repeats=tuple({"rte": trial.mean_error} | trial.metrics for trial in repeats),
        unhealthy=max(repeats, key=lambda trial: trial.unhealthy.get("no_pose", 0)).unhealthy,
        failure=next((trial.failure for trial in repeats if trial.failure), ""),
    )
