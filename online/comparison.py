"""Baseline, fixed and adaptive, on sequences that nothing was trained on."""

import csv
import itertools
import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import report
from adaptune.descriptor import DescriptorError
from adaptune.errors import AdaptuneError
from adaptune.metrics import KittiError, bootstrap, kitti_error, span, sub_trajectory_rte
from adaptune.model import ErrorModel, Selection
from adaptune.odometry.bank import Bank
from adaptune.odometry.base import OdometryInstance
from adaptune.odometry.hand_over import HandOver
from adaptune.report import Track
from adaptune.space import ParameterSet
from adaptune.study import Study
from adaptune.trajectory import Trajectory, read_tum, write_tum
from online.replay import Policy, adaptive, replay, write_replay

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""

SCANT = 1.5
"""Training sequences below which a selection rests on hardly more than one."""

_log = logging.getLogger(__name__)


class ComparisonError(AdaptuneError):
    """Replays that are missing or do not go with the model."""


def modes(study: Study) -> tuple[str, ...]:
    """What is compared: baseline, fixed, and each selection rule."""
    return ("baseline", "fixed", *study.rules)


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
    model.check_study(study.identity, study.space, model_path)
    # The set that adaptive modes begin with.
    members = bank_sets(study, model)[0] if study.mechanism == "bank" else None
    fixed = model.fixed if members is None else members[0]
    if not study.config.test:
        raise ComparisonError("test: name at least one sequence to replay")
    study.open()
    digest = model.digest
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

            box, policy = driven(study, model, mode, name)
            try:
                result = replay(
                    sequence,
                    box,
                    study.config.health,
                    policy,
                    model.sets,
                    study.config.online.period,
                    step,
                    members,
                )
            except DescriptorError as error:
                raise ComparisonError(f"sequences.{name}: {error}") from error
            progress(what, n, n)
            if not made_here:
                _write_reference(folder, sequence.reference(), result.trajectory)
            write_replay(folder / mode, result, about)
            _warn_of_scant_evidence(what, [c.selection for c in result.choices], fixed)
            made_here += 1
        made += made_here
    return made


def _warn_of_scant_evidence(what: str, selections: Sequence[Selection], fixed: int) -> None:
    left = [s for s in selections if s.set_index != fixed]
    few = sum(s.sequences < SCANT for s in left)
    if few:
        _log.warning(
            "%s: %d of %d selections of another set than the fixed one rest on hardly more than "
            "one training sequence (selections.csv tells which); more sequences would show "
            "whether they hold",
            what,
            few,
            len(left),
        )


def driven(
    study: Study, model: ErrorModel, mode: str, name: str
) -> tuple[OdometryInstance, Policy | None]:
    """What a mode drives through a recording, and what chooses its parameters.

    Parameters
    ----------
    study
        The study.
    model
        The error model.
    mode
        One of `modes`.
    name
        The sequence that it will be driven along.
    """
    fixed = model.sets[model.fixed]
    if mode not in study.rules:
        return study.odometry(fixed if mode == "fixed" else None, name), None
    switching = study.config.online.switching
    mechanism = study.mechanism
    if mechanism == "bank" and mode == "paired" and model.fusion.hedge == 1.0:
        # It was not shown to pay: others than the fixed set would only cost.
        mechanism = "live" if study.described.live else "hand_over"
    if mechanism == "live":
        return study.odometry(fixed), adaptive(model, mode, study.price())
    if mechanism == "hand_over":
        box = HandOver(study.odometry, fixed, study.warm_up, switching.catch_up_scans)
        return box, adaptive(model, mode, study.price())
    members, sets = bank_sets(study, model)
    by_number = dict(zip(members, sets, strict=True))
    bank = Bank(study.odometry, by_number, study.warm_up, study.config.lost_track)
    return bank, adaptive(model, mode, members=members)


def bank_sets(study: Study, model: ErrorModel) -> tuple[list[int], list[ParameterSet]]:
    """Numbers in the model, and parameters, of the sets in a study's bank, the first one first.

    Raises
    ------
    ComparisonError
        If the model knows nothing of a set that is named, or one is named twice.
    """
    given = study.config.online.switching.sets
    if given is None:
        size = study.config.online.switching.size
        complete = int((~np.isnan(model.errors).any(axis=0)).sum())
        if len(model.bank) < min(size, complete):
            raise _another_bank("size")
        if model.bank[0] != model.fixed:
            raise _another_bank("sets")
        members = model.bank[:size]
        return members, [model.sets[i] for i in members]
    members = []
    for i, named in enumerate(given):
        number = model.number(named)
        if number is None:
            raise ComparisonError(
                f"online.switching.sets.{i}: is none of the {len(model.sets)} parameter sets that "
                f"were tried, so nothing is known of its errors; name the number of a trial, or "
                f"the parameters of one (trials.csv lists them)"
            )
        if number in members:
            raise ComparisonError(f"online.switching.sets.{i}: is in the bank already")
        if np.isnan(model.errors[:, number]).any():
            raise ComparisonError(
                f"online.switching.sets.{i}: was not run on every training sequence, so it cannot "
                f"be compared with the others; name another (trials.csv tells which were)"
            )
        members.append(number)
    if members != model.bank:
        raise _another_bank("sets")
    return members, [model.sets[i] for i in members]


def _another_bank(key: str) -> ComparisonError:
    return ComparisonError(
        f"online.switching.{key}: the model was fitted for another bank; run `adaptune offline` "
        f"again, which fits it to the trials there are"
    )


def _about(study: Study, name: str, mode: str, model: ErrorModel, digest: str) -> dict[str, Any]:
    """All that a replay depends on."""
    parameters: ParameterSet | None = None
    if mode == "baseline":
        parameters = study.space.baseline
    elif mode == "fixed":
        parameters = model.sets[model.fixed]
    about: dict[str, Any] = {
        "mode": mode,
        "parameters": parameters,
        "model": None if parameters else digest,
        "switching": None if parameters else _switching(study),
    }
    return about | _setting(study, name)


def _setting(study: Study, name: str) -> dict[str, Any]:
    """What every mode's replay of a sequence depends on."""
    course = study.config.courses.get(name)
    return {
        "period": study.config.online.period,
        "odometry": study.config.odometry.model_dump(mode="json"),
        "health": study.config.health.model_dump(mode="json"),
        "sequence": study.sequence_config(name).model_dump(mode="json"),
        "course": None if course is None else course.model_dump(mode="json"),
        "recording": study.recording_size(name),
    }


def _switching(study: Study) -> dict[str, Any]:
    """The mechanism, those of its settings that it heeds, and its price."""
    heeded = {"live": set[str](), "hand_over": {"catch_up_scans"}, "bank": {"size", "sets"}}
    settings = study.config.online.switching.model_dump(
        mode="json", include=heeded[study.mechanism]
    )
    if study.mechanism != "live":
        settings["warm_up"] = study.warm_up._asdict()
    if study.mechanism != "bank":
        settings["price"] = study.price()
    return {"mechanism": study.mechanism} | settings


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
    check_replays(study)
    rows: list[dict[str, Any]] = []
    ratios: dict[str, list[float]] = {mode: [] for mode in modes(study)}
    for name in study.config.test:
        folder = study.folder / "replays" / name
        tracks = {mode: _track(folder, mode, study) for mode in modes(study)}
        errors = {mode: track.errors for mode, track in tracks.items()}
        # Without a reference there are no errors to be drawn.
        path = folder / "reference.tum"
        length = study.config.sub_trajectory
        block = span(read_tum(path).T_world_sensor, length) if path.exists() else 1
        for mode, track in tracks.items():
            summary = _summary(folder / mode)
            row = _row(name, mode, track, errors["fixed"], block, summary, _kitti(folder, mode))
            rows.append(row)
            if row["vs fixed"] is not None:
                ratios[mode].append(row["vs fixed"])
        report.draw_tracks(
            study.folder / "comparison" / f"{name}.png",
            f"{study.name}: {name}",
            study.config.sub_trajectory,
            tracks,
            [n for n, p in study.space.parameters.items() if getattr(p, "log", False)],
        )
    if len(ratios["fixed"]) > 1:
        rows += _pooled(rows, ratios)
    report.write_rows(study.folder / "comparison", "comparison", rows)
    return rows


def check_replays(study: Study) -> None:
    """Refuse replays that are missing, or of another recording or configuration.

    Raises
    ------
    ComparisonError
    """
    for name in study.config.test:
        for mode in modes(study):
            folder = study.folder / "replays" / name / mode
            made = _summary(folder)["about"]
            now = _setting(study, name)
            if differing := [key for key in now if made.get(key) != now[key]]:
                raise ComparisonError(
                    f"{folder}: was replayed with another {', '.join(differing)}; run `adaptune "
                    f"online` with this study"
                )


def _summary(folder: Path) -> dict[str, Any]:
    """What is said of a replay; all its files are there, for this one is written last."""
    path = folder / "replay.json"
    if not path.exists():
        raise ComparisonError(
            f"{folder}: there is no replay; run `adaptune online` with this study first"
        )
    try:
        summary = dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise _damaged(path, error) from error
    if missing := {"about", "restarts", "poor_scans", "duration_s", "replay_s"} - set(summary):
        raise _damaged(path, KeyError(*missing))
    return summary


def _damaged(path: Path, error: Exception) -> ComparisonError:
    return ComparisonError(f"{path}: is damaged ({error}); run `adaptune online --again`")


def _kitti(folder: Path, mode: str) -> KittiError:
    """KITTI's error over 100 to 800 m, where the drive is long enough and the truth is known."""
    if not (folder / "reference.tum").exists():
        return KittiError(np.nan, np.nan, ())
    reference = read_tum(folder / "reference.tum")
    odometry = read_tum(folder / mode / "trajectory.tum")
    both = np.isin(odometry.stamps, reference.stamps)
    return kitti_error(reference.T_world_sensor, odometry.T_world_sensor[both])


def _track(folder: Path, mode: str, study: Study) -> Track:
    odometry = read_tum(folder / mode / "trajectory.tum")
    stamps = odometry.stamps
    errors = np.full(len(stamps), np.nan)
    if (folder / "reference.tum").exists():
        T_ref_sensor = read_tum(folder / "reference.tum").at(stamps)
        errors = sub_trajectory_rte(
            T_ref_sensor, odometry.T_world_sensor, study.config.sub_trajectory
        )
    frames = _columns(folder / mode / "frames.csv")
    if len(frames.get("restarted", [])) != len(stamps):
        raise _damaged(folder / mode / "frames.csv", ValueError("not a row for every scan"))
    choices = _columns(folder / mode / "selections.csv")
    chosen: dict[str, Sequence[Any]] = {name: choices.get(name, []) for name in study.space.names}
    try:
        at = np.array([int(s) for s in choices.get("stamp_ns", [])], np.int64)
    except (TypeError, ValueError) as error:
        raise _damaged(folder / mode / "selections.csv", error) from error
    if not len(at):
        about = _summary(folder / mode)["about"]
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
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error
    return {key: [row[key] for row in rows] for key in (rows[0] if rows else {})}


def _numbers(values: Sequence[str]) -> list[Any]:
    try:
        return [float(value) for value in values]
    except ValueError:
        return list(values)


def _row(
    name: str,
    mode: str,
    track: Track,
    fixed: NDArray[np.float64],
    block: int,
    summary: dict[str, Any],
    kitti: KittiError,
) -> dict[str, Any]:
    known = np.isfinite(track.errors) & np.isfinite(fixed)
    mean = low = high = ratio = ratio_low = ratio_high = None
    if known.any():
        mean = float(track.errors[known].mean())
        ratio = mean / max(float(fixed[known].mean()), 1e-12)
        if intervals := bootstrap(track.errors[known], fixed[known], block):
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
        "_blocks": int(known.sum() // block),
        "_median": float(np.median(track.errors[known])) if known.any() else None,
        "_kitti_percent": kitti.translation,
        "_kitti_deg_per_m": kitti.rotation,
    }


def _pooled(rows: list[dict[str, Any]], ratios: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Over all sequences: the mean RTE, and the geometric mean of the ratios."""
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
