"""Which replays are compared: the modes that were replayed on every sequence."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from adaptune.drawing import LINES
from adaptune.model import ErrorModel
from adaptune.study.config import ALSO
from adaptune.study.driven import RIVALS
from adaptune.study.study import Study
from online.modes import BASELINE, UNTRAINED, WITHOUT_MODEL, ReplaySetup, sequences_without_model
from online.stored_replays import ReplaySummary, StoredReplayError


class ComparedModes(NamedTuple):
    """What is compared."""

    sequences: tuple[str, ...]
    modes: tuple[str, ...]  # replayed on all of them, in the order of `LINES`
    twins: Mapping[str, str]  # by mode that is not replayed itself, the one whose replay it has
    # By mode that somebody may expect, the sequences on which it was not replayed.
    missing: Mapping[str, Sequence[str]]
    unfinished: Sequence[str] = ()  # sequences that are not compared, for want of replays

    def words(self, study: Study) -> list[str]:
        """Sentences about what is not shown because another mode is the same, or is missing."""
        said = [
            f"`{mode}` is what `{twin}` drives here: it has the same numbers, shown once."
            for mode, twin in self.twins.items()
        ]
        if self.unfinished:
            there = [m for m in self.modes if m not in ALSO or self.modes == WITHOUT_MODEL]
            lacking = (
                f"{name} ({', '.join(f'`{m}`' for m in there if not _is_there(study, name, m))})"
                for name in self.unfinished
            )
            command = replayed_by(study, UNTRAINED if self.modes == WITHOUT_MODEL else "fixed")
            said.append(
                f"Not compared, because replays are missing: {', '.join(lacking)}; "
                f"{command} makes them."
            )
        where: dict[tuple[str, ...], list[str]] = {}
        for mode, names in self.missing.items():
            where.setdefault(tuple(names), []).append(mode)
        for names, modes in where.items():
            are = "are" if len(modes) > 1 else "is"
            each = " and ".join(f"`{mode}`" for mode in modes)
            on = "any sequence" if names == self.sequences else " and ".join(names)
            command = " or ".join(dict.fromkeys(replayed_by(study, mode) for mode in modes))
            said.append(
                f"{each} {are} not compared: there is no replay on {on}; {command} makes what "
                f"is missing."
            )
        return said


def replayed_by(study: Study, mode: str) -> str:
    """The command that replays a mode, as `adaptune online --thorough`."""
    on_demand = mode in ALSO and mode not in study.config.online.also
    option = "--untrained" if mode == UNTRAINED else "--thorough"
    return f"`adaptune online{f' {option}' if on_demand else ''}`"


def compared_modes(study: Study) -> ComparedModes:
    """Find what was replayed on all test sequences, or without a model.

    Raises
    ------
    StoredReplayError
        If the fixed set was replayed on none of them, and baseline and untrained bank not on all.
    """
    setup = ReplaySetup.of(study)
    names, without_model = study.config.test, sequences_without_model(study)
    of_model = [mode for mode in LINES if mode not in WITHOUT_MODEL]
    if not _any(study, names, of_model) and _any(study, without_model, [UNTRAINED]):
        made, unfinished = _finished(study, without_model, WITHOUT_MODEL)
        if made:
            return ComparedModes(made, WITHOUT_MODEL, {}, {}, unfinished)
    if not names:
        raise StoredReplayError("test: name at least one sequence to compare on")
    unfixed = [name for name in names if not _is_there(study, name, "fixed")]
    if len(unfixed) == len(names):
        if all(_is_there(study, name, m) for name in names for m in WITHOUT_MODEL):
            return ComparedModes(names, WITHOUT_MODEL, {}, {"fixed": unfixed})
        ReplaySummary.read(_folder(study, names[0], "fixed"))
    names, unfinished = _finished(study, names, ("fixed", BASELINE, *setup.rules))
    model = _model(study, names[0])
    also = _on_demand(study, setup, model)
    twins = {} if model is None else {m: setup.twin(m, model) for m in also}
    twins = {mode: twin for mode, twin in twins.items() if twin != mode}
    there = {
        mode: [name for name in names if _is_there(study, name, mode)]
        for mode in LINES
        if mode in (BASELINE, *RIVALS, "fixed", *setup.rules, *also) and mode not in twins
    }
    expected = (BASELINE, *setup.rules, *also)
    return ComparedModes(
        names,
        tuple(mode for mode, on in there.items() if len(on) == len(names)),
        {mode: twin for mode, twin in twins.items() if len(there.get(twin, [])) == len(names)},
        {
            mode: [name for name in names if name not in on]
            for mode, on in there.items()
            if len(on) < len(names) and mode in expected
        },
        unfinished,
    )


def _finished(
    study: Study, names: Sequence[str], modes: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Sequences that were replayed in all modes that any was, and those that were not yet."""
    made = [mode for mode in modes if _any(study, names, [mode])]
    finished = tuple(n for n in names if all(_is_there(study, n, mode) for mode in made))
    if not finished:  # no mode is everywhere: those with the fixed set are compared
        finished = tuple(n for n in names if _is_there(study, n, "fixed"))
    return finished, tuple(name for name in names if name not in finished)


def _on_demand(study: Study, setup: ReplaySetup, model: ErrorModel | None) -> list[str]:
    """The modes on demand that were asked for or replayed, and those that are another's replay."""
    names, asked = study.config.test, study.config.online.also
    found: list[str] = [mode for mode in ALSO if mode in asked or _any(study, names, [mode])]
    if model is None:
        return found
    if any(mode != UNTRAINED for mode in found):
        found += [mode for mode in ALSO if mode not in found and setup.twin(mode, model) != mode]
    return [mode for mode in found if not setup.obstacle(mode, model)]


def _model(study: Study, name: str) -> ErrorModel | None:
    """The model of the replays of a sequence; None if its file is gone, or they need none."""
    there = (mode for mode in LINES if _is_there(study, name, mode))
    summaries = (ReplaySummary.read(_folder(study, name, mode)) for mode in there)
    files = [s.model_file for s in summaries if s.model_file and s.about.model]
    path = Path(files[0]) if files else study.model_path
    return ErrorModel.load(path) if path.exists() else None


def _any(study: Study, names: Iterable[str], modes: Sequence[str]) -> bool:
    return any(_is_there(study, name, mode) for name in names for mode in modes)


def _is_there(study: Study, name: str, mode: str) -> bool:
    return (_folder(study, name, mode) / "replay.json").exists()


def _folder(study: Study, name: str, mode: str) -> Path:
    return study.folder / "replays" / name / mode
