"""Replays that are not of what the study is now: neither compared nor drawn."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from adaptune.drawing import LINES
from adaptune.model import ErrorModel
from adaptune.study.config import ALSO
from adaptune.study.driven import RIVALS
from adaptune.study.inputs import check_model
from adaptune.study.study import Study
from online.compared_modes import replayed_by
from online.modes import BASELINE, UNTRAINED, WITHOUT_MODEL, ReplaySetup
from online.run_replays import shared_identity
from online.stored_reference import check_reference
from online.stored_replays import ReplaySummary, StoredReplayError


class CurrentModes(NamedTuple):
    """The modes whose replays of a sequence are of what the study is now."""

    modes: tuple[str, ...]  # in the order of `LINES`
    refused: tuple[str, ...]  # sentences about the others


def check_replays(
    study: Study, setup: ReplaySetup, names: Sequence[str], modes: Sequence[str]
) -> ErrorModel | None:
    """Refuse replays that are missing, or of another recording, model or configuration.

    Returns
    -------
    ErrorModel or None
        What the replays are of; None if its file is not there any more.

    Raises
    ------
    StoredReplayError
    """
    made = {
        (name, mode): ReplaySummary.read(study.folder / "replays" / name / mode)
        for name in names
        for mode in modes
    }
    path, model = _model_of(study, made.values())
    model = model and setup.pinned(model)
    # Both read what they are about.
    shared = {name: shared_identity(study, name) for name in names}
    _check_rates(study, made.values())
    for (name, mode), summary in made.items():
        if differing := _differing(study, setup, summary, model, shared[name]):
            command = _command(study, mode, path)
            raise StoredReplayError(_refusal(study, name, [mode], differing, command))
    for name in names:
        _check_reference(study, name, modes)
    return model


def current_modes(study: Study, name: str) -> CurrentModes:
    """Tell the replays of a sequence that `check_replays` would refuse from the others.

    Of replays with different models, those with the study's own are the others.

    Raises
    ------
    AdaptuneError
        If it would refuse all of them.
    """
    folder, setup = study.folder / "replays" / name, ReplaySetup.of(study)
    there = [mode for mode in LINES if (folder / mode / "replay.json").exists()]
    made = {mode: ReplaySummary.read(folder / mode) for mode in there}
    if not made:
        return CurrentModes((), ())
    own = study.model_path.resolve()
    if len(_files(made.values())) > 1 and own.exists():
        of: tuple[Path, ErrorModel | None] = own, _load(study, own)
    else:
        of = _model_of(study, made.values())
    path, model = of[0], of[1] and setup.pinned(of[1])
    considered = _considered(setup, model)
    made = {mode: summary for mode, summary in made.items() if mode in considered}
    _check_rates(study, made.values())
    _check_reference(study, name, list(made))
    shared = shared_identity(study, name)
    current, refused = [], dict[tuple[str, ...], list[str]]()
    for mode, summary in made.items():
        if differing := _differing(study, setup, summary, model, shared):
            refused.setdefault((_command(study, mode, path), *differing), []).append(mode)
        else:
            current.append(mode)
    said = (
        f"{_refusal(study, name, modes, differing, command)}."
        for (command, *differing), modes in refused.items()
    )
    return CurrentModes(tuple(current), tuple(said))


def _considered(setup: ReplaySetup, model: ErrorModel | None) -> set[str]:
    """The modes that the study may have; a replay that is left of another one is not looked at."""
    rivals: Iterable[str] = RIVALS
    also: Iterable[str] = ALSO
    if model is not None:
        rivals = [mode for mode in RIVALS if mode in model.rivals]
        also = [m for m in ALSO if setup.twin(m, model) == m and not setup.obstacle(m, model)]
    return {BASELINE, *rivals, "fixed", *setup.rules, *also}


def _differing(
    study: Study,
    setup: ReplaySetup,
    summary: ReplaySummary,
    model: ErrorModel | None,
    shared: Mapping[str, Any],
) -> list[str]:
    """In what a replay differs from one that would be made now, given what all modes share."""
    # What was made in real time may be compared without saying so.
    now, about = {**shared, "real_time": None}, summary.about.model_dump() | {"real_time": None}
    mode = summary.about.mode
    if model is not None or mode in WITHOUT_MODEL:
        whole = setup.identity(mode, model, "" if model is None else model.digest)
        now |= {key: whole[key] for key in ("model", "parameters")}
        if not _is_automatic(study, whole["switching"], about["switching"]):
            now["switching"] = whole["switching"]
    return [key for key, value in now.items() if about[key] != value]


def _command(study: Study, mode: str, path: Path) -> str:
    """The command that makes a replay again, with the model of a file."""
    command = replayed_by(study, mode)
    if mode == UNTRAINED or path == study.model_path.resolve():
        return command
    return f"{command[:-1]} --model {path}`"


def _refusal(
    study: Study, name: str, modes: Sequence[str], differing: Sequence[str], command: str
) -> str:
    """Why replays of a sequence are refused."""
    folder = study.folder / "replays" / name
    what = f"{folder / modes[0]}: was" if len(modes) == 1 else f"{folder}: {', '.join(modes)} were"
    return f"{what} replayed with another {', '.join(differing)}; run {command} with this study"


def _check_rates(study: Study, summaries: Collection[ReplaySummary]) -> None:
    if len({str(summary.about.real_time) for summary in summaries}) > 1:
        raise StoredReplayError(
            f"{study.folder / 'replays'}: some were made in real time, and others not, or not so; "
            f"run `adaptune online` again, with --rate or without"
        )


def _check_reference(study: Study, name: str, modes: Sequence[str]) -> None:
    option = " --untrained" if UNTRAINED in modes and "fixed" not in modes else ""
    check_reference(study.folder / "replays" / name, study.sequences.reference(name), option)


def _files(summaries: Iterable[ReplaySummary]) -> dict[str, str]:
    """The files of the models of replays, by digest."""
    return {s.about.model: s.model_file for s in summaries if s.about.model and s.model_file}


def _model_of(study: Study, summaries: Collection[ReplaySummary]) -> tuple[Path, ErrorModel | None]:
    """File of the model that all replays are of, and the model if the file is still there."""
    files = _files(summaries)
    if len(files) > 1:
        commands = {replayed_by(study, s.about.mode) for s in summaries if s.about.model}
        raise StoredReplayError(
            f"{study.folder / 'replays'}: holds replays with different models "
            f"({' and '.join(sorted(set(files.values())))}); run {max(commands, key=len)} again"
        )
    path = Path(next(iter(files.values()), study.model_path.resolve()))
    return path, _load(study, path) if path.exists() else None


def _load(study: Study, path: Path) -> ErrorModel:
    """A model; the study's own is still of its recordings."""
    model = ErrorModel.load(path)
    if path == study.model_path.resolve():
        check_model(study, model.sequences, model.provenance)
    return model


def _is_automatic(study: Study, now: Any, made: Any) -> bool:
    """Whether a replay differs only in the mechanism that this machine would choose."""
    if study.config.online.switching.mechanism != "auto" or None in (now, made):
        return False
    return bool(now["mechanism"] != made["mechanism"])
