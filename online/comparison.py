"""Baseline, fixed and adaptive, on sequences that nothing was trained on."""

import csv
import hashlib
import itertools
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import report
from adaptune.errors import AdaptuneError
from adaptune.metrics import sub_trajectory_rte, window_ends
from adaptune.model import ErrorModel
from adaptune.report import Track
from adaptune.space import ParameterSet
from adaptune.study import Study
from adaptune.trajectory import Trajectory, read_tum, write_tum
from online.replay import adaptive, replay, write_replay

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

RESAMPLES = 2000


class ComparisonError(AdaptuneError):
    """Replays that are missing or do not go with the model."""


def modes(study: Study) -> tuple[str, ...]:
    """What is compared: baseline, fixed, and each selection rule."""
    return ("baseline", "fixed", *study.config.online.rules)


def run_replays(
    study: Study, model_path: Path, again: bool = False, progress: Progress = lambda *_: None
) -> int:
    """Replay every test sequence in every mode, unless that was done before.

    Parameters
    ----------
    study
        The study; ``replays/<sequence>/<mode>`` in its folder receives the results.
    model_path
        The error model.
    again
        Replay even what was done before.
    progress
        Told about every scan.

    Returns
    -------
    int
        How many replays were made.

    Raises
    ------
    AdaptuneError
        If there is no test sequence, or the model is of another odometry or other parameters.
    """
    model = ErrorModel.load(model_path)
    check_model(study, model, model_path)
    if not study.config.test:
        raise ComparisonError("test: name at least one sequence to replay")
    digest = hashlib.sha256(model_path.read_bytes()).hexdigest()[:16]
    made = 0
    for name in study.config.test:
        folder = study.folder / "replays" / name
        sequence, made_here = None, 0
        for mode in modes(study):
            about = _about(study, name, mode, model, digest)
            if not again and _about_before(folder / mode) == about:
                continue
            if sequence is None:
                sequence = study.sequence(name)
            what, n = f"{name}, {mode}", sequence.n_messages
            done = 0

            def step(what: str = what, n: int = n) -> None:
                nonlocal done
                done += 1
                progress(what, done, n)

            parameters = model.sets[model.fixed] if mode != "baseline" else None
            result = replay(
                sequence,
                study.odometry(parameters),
                study.config.health,
                adaptive(model, mode) if mode in study.config.online.rules else None,
                model.sets,
                study.config.online.period,
                step,
            )
            if not made_here:
                _write_reference(folder, sequence.reference(), result.trajectory)
            write_replay(folder / mode, result, about)
            made_here += 1
        made += made_here
    return made


def check_model(study: Study, model: ErrorModel, path: Path) -> None:
    """Refuse a model that was not made for this odometry.

    Raises
    ------
    ComparisonError
    """
    odometry = {
        "name": study.config.odometry.name,
        "settings": study.settings.model_dump(mode="json"),
    }
    if model.odometry != odometry:
        raise ComparisonError(
            f"{path}: is a model of {json.dumps(model.odometry)}, the study's odometry is "
            f"{json.dumps(odometry)}; run `adaptune offline` for this study"
        )
    if model.space != study.space:
        raise ComparisonError(
            f"{path}: is a model of other parameters or ranges than the study's; run `adaptune "
            f"offline` for this study"
        )
    if study.config.online.rules and not study.box.live:
        raise ComparisonError(
            f"odometry.name: {study.config.odometry.name} cannot change its parameters between "
            f"scans; set online.rules to [] to compare baseline and fixed"
        )


def _about(study: Study, name: str, mode: str, model: ErrorModel, digest: str) -> dict[str, Any]:
    """All that a replay depends on."""
    parameters: ParameterSet | None = None
    if mode == "baseline":
        parameters = study.space.baseline
    elif mode == "fixed":
        parameters = model.sets[model.fixed]
    course = study.config.courses.get(name)
    about: dict[str, Any] = {
        "mode": mode,
        "parameters": parameters,
        "model": None if parameters else digest,
        "period": study.config.online.period,
        "odometry": study.config.odometry.model_dump(mode="json"),
        "health": study.config.health.model_dump(mode="json"),
        "sequence": study.sequence_config(name).model_dump(mode="json"),
        "course": None if course is None else course.model_dump(mode="json"),
    }
    return about


def _about_before(folder: Path) -> object:
    try:
        return json.loads((folder / "replay.json").read_text(encoding="utf-8"))["about"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _write_reference(folder: Path, reference: Trajectory | None, odometry: Trajectory) -> None:
    """Write ``reference.tum``, at the scans' stamps; remove it if there is none."""
    path = folder / "reference.tum"
    if reference is None:
        path.unlink(missing_ok=True)
        return
    T = reference.at(odometry.stamps)
    known = ~np.isnan(T[:, 0, 0])
    if not known.any():
        raise ComparisonError(
            f"{folder.name}: the reference does not overlap the scans in time; check that "
            f"both are of the same recording and clock"
        )
    write_tum(path, Trajectory(odometry.stamps[known], T[known]))


def compare(study: Study) -> list[dict[str, Any]]:
    """Compare the replays that were made, and write tables and pictures.

    Parameters
    ----------
    study
        The study; its folder receives ``comparison.csv``, ``comparison.json`` and a PNG for every
        sequence in ``comparison``.

    Returns
    -------
    list of dict
        A row for every sequence and mode, and a row for every mode over all sequences.

    Raises
    ------
    ComparisonError
        If a replay is missing.
    """
    rows: list[dict[str, Any]] = []
    ratios: dict[str, list[float]] = {mode: [] for mode in modes(study)}
    for name in study.config.test:
        folder = study.folder / "replays" / name
        tracks = {mode: _track(folder, mode, study) for mode in modes(study)}
        errors = {mode: track.errors for mode, track in tracks.items()}
        block = _block(folder, study, errors["fixed"])
        for mode, track in tracks.items():
            summary = json.loads((folder / mode / "replay.json").read_text(encoding="utf-8"))
            row = _row(name, mode, track, errors["fixed"], block, summary)
            rows.append(row)
            if row["vs fixed"] is not None:
                ratios[mode].append(row["vs fixed"])
        report.draw_tracks(
            study.folder / "comparison" / f"{name}.png",
            f"{study.name}: {name}",
            study.config.sub_trajectory,
            tracks,
        )
    if len(ratios["fixed"]) > 1:
        rows += _pooled(rows, ratios)
    report.write_rows(study.folder / "comparison", "comparison", rows)
    return rows


def _track(folder: Path, mode: str, study: Study) -> Track:
    if not (folder / mode / "replay.json").exists():
        raise ComparisonError(
            f"{folder / mode}: there is no replay; run `adaptune online` with this study first"
        )
    odometry = read_tum(folder / mode / "trajectory.tum")
    stamps = odometry.stamps
    errors = np.full(len(stamps), np.nan)
    if (folder / "reference.tum").exists():
        T_ref_sensor = read_tum(folder / "reference.tum").at(stamps)
        errors = sub_trajectory_rte(
            T_ref_sensor, odometry.T_world_sensor, study.config.sub_trajectory
        )
    frames = _columns(folder / mode / "frames.csv")
    choices = _columns(folder / mode / "selections.csv")
    chosen: dict[str, Sequence[Any]] = {name: choices.get(name, []) for name in study.space.names}
    at = np.array([int(s) for s in choices.get("stamp_ns", [])], np.int64)
    if not len(at):
        about = json.loads((folder / mode / "replay.json").read_text(encoding="utf-8"))["about"]
        chosen = {name: [about["parameters"][name]] for name in study.space.names}
        at = stamps[:1]
    else:
        chosen = {name: _numbers(values) for name, values in chosen.items()}
    return Track(
        (stamps - stamps[0]) * 1e-9,
        errors,
        np.array(frames["restarted"]) == "1",
        (at - stamps[0]) * 1e-9,
        chosen,
    )


def _columns(path: Path) -> dict[str, list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {key: [row[key] for row in rows] for key in (rows[0] if rows else {})}


def _numbers(values: Sequence[str]) -> list[Any]:
    try:
        return [float(value) for value in values]
    except ValueError:
        return list(values)


def _block(folder: Path, study: Study, errors: NDArray[np.float64]) -> int:
    """Frames that a sub-trajectory takes: errors nearer to each other share their windows."""
    if not (folder / "reference.tum").exists():
        return 1
    reference = read_tum(folder / "reference.tum")
    ends = window_ends(reference.T_world_sensor, study.config.sub_trajectory)
    starts = np.flatnonzero(ends >= 0)
    return int(np.median(ends[starts] - starts)) if len(starts) else max(1, len(errors))


def _row(
    name: str,
    mode: str,
    track: Track,
    fixed: NDArray[np.float64],
    block: int,
    summary: dict[str, Any],
) -> dict[str, Any]:
    known = np.isfinite(track.errors) & np.isfinite(fixed)
    mean = low = high = ratio = ratio_low = ratio_high = None
    if known.any():
        mean, ratio, intervals = bootstrap(track.errors[known], fixed[known], block)
        (low, high), (ratio_low, ratio_high) = intervals
    switches = 0
    if len(track.choice_seconds) > 1:
        values = list(zip(*track.choices.values(), strict=True))
        switches = sum(a != b for a, b in itertools.pairwise(values))
    return {
        "sequence": name,
        "mode": mode,
        "RTE [%]": mean,
        "vs fixed": ratio,
        "95 %": None if ratio_low is None else f"{ratio_low:.2f}-{ratio_high:.2f}",
        "restarts": summary["restarts"],
        "switches": switches,
        "_poor_scans": summary["poor_scans"],
        "_x_real_time": round(summary["duration_s"] / summary["replay_s"], 2),
        "_rte_low": low,
        "_rte_high": high,
        "_ratio_low": ratio_low,
        "_ratio_high": ratio_high,
    }


def bootstrap(
    errors: NDArray[np.float64], fixed: NDArray[np.float64], block: int, seed: int = 0
) -> tuple[float, float, tuple[tuple[float, float], tuple[float, float]]]:
    """Mean error, its ratio to the fixed set's, and the 95 % intervals of both.

    A moving-block bootstrap (Künsch, Annals of Statistics 1989): errors of neighbouring frames
    share most of their sub-trajectories and are drawn together. It speaks of one drive, not of
    other places.

    Parameters
    ----------
    errors, fixed
        Percent, of the same frames, of shape (n,).
    block
        Frames drawn together.
    seed
        Of the resampling.
    """
    n = len(errors)
    block = min(block, n)
    n_blocks = -(-n // block)
    starts = np.random.default_rng(seed).integers(0, n - block + 1, (RESAMPLES, n_blocks))
    means = []
    for values in (errors, fixed):
        sums = np.concatenate([[0.0], np.cumsum(values)])
        means.append((sums[starts + block] - sums[starts]).sum(axis=1) / (n_blocks * block))
    ratios = means[0] / np.maximum(means[1], 1e-12)
    low, high = np.percentile(means[0], [2.5, 97.5])
    ratio_low, ratio_high = np.percentile(ratios, [2.5, 97.5])
    return (
        float(errors.mean()),
        float(errors.mean() / max(fixed.mean(), 1e-12)),
        ((float(low), float(high)), (float(ratio_low), float(ratio_high))),
    )


def _pooled(rows: list[dict[str, Any]], ratios: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Over all sequences: the mean RTE, the geometric mean of the ratios, and their extremes."""
    pooled = []
    for mode, of_mode in ratios.items():
        mine = [row for row in rows if row["mode"] == mode and row["RTE [%]"] is not None]
        row = dict.fromkeys(rows[0])
        row |= {
            "sequence": f"all {len(mine)}",
            "mode": mode,
            "RTE [%]": float(np.mean([r["RTE [%]"] for r in mine])),
            "vs fixed": float(np.exp(np.mean(np.log(np.maximum(of_mode, 1e-12))))),
            "restarts": sum(r["restarts"] for r in mine),
            "_poor_scans": sum(r["_poor_scans"] for r in mine),
            "switches": sum(r["switches"] for r in mine),
        }
        pooled.append(row)
    return pooled
