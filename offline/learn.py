"""Learn from another drive: train with it, and tell what has changed by it."""

from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import NamedTuple, Self

from adaptune.errors import AdaptuneError
from adaptune.model import ErrorModel, ModelError
from adaptune.space import ParameterSet, Value
from adaptune.study.loading import LearnedDrives
from adaptune.study.new_drive import NewDrive
from adaptune.study.study import BANK, ONE_SET, ModeError, driven, expected_in_words
from offline.campaign import Progress
from offline.config import OfflineStudy
from offline.train import Training, train


class LearnError(AdaptuneError):
    """A drive from which nothing was learned."""


class Known(NamedTuple):
    """What a study has found out: what an error model says, and what is driven with it.

    Attributes
    ----------
    fixed : int
        Trial number of the fixed set.
    parameters : dict
        The fixed set.
    way : str, optional
        How `adaptive` adapts: `BANK` or `ONE_SET`; None if it drives the fixed set.
    members : list of int
        Trial numbers of the bank's members, if there is a bank, driven or not.
    expected : dict
        By way to adapt, see `ErrorModel.expected`.
    n_sets : int
        Number of parameter sets that were compared.
    """

    fixed: int
    parameters: ParameterSet
    way: str | None
    members: list[int]
    expected: Mapping[str, Mapping[str, float]]
    n_sets: int = 0

    @classmethod
    def of(cls, study: OfflineStudy, model: ErrorModel) -> Self:
        """What is known with a model of the study."""
        mechanism = driven(study, model).mechanism
        way = None if mechanism is None else BANK if mechanism == "bank" else ONE_SET
        of_model = model.bank, model.expected, len(model.sets)
        return cls(model.fixed, model.sets[model.fixed], way, *of_model)


class Lesson(NamedTuple):
    """What was learned from a drive."""

    study: OfflineStudy  # with the drive
    training: Training
    words: list[str]  # what has changed, and what was run


def learn(
    study: OfflineStudy,
    drive: NewDrive,
    reload: Callable[[], OfflineStudy],
    progress: Progress = lambda *_: None,
) -> Lesson:
    """Add a drive to the training sequences, run the trials that are missing, and fit again.

    If it is interrupted, the drive stays among the training sequences, and the study can be
    resumed. After an error, it is not, unless the model knows it already. If an earlier run was
    interrupted, only an error that says what is wrong with it takes it out again.

    Parameters
    ----------
    study
        The study as it is now.
    drive
        What it is to learn from.
    reload
        Loads the study again.
    progress
        Called about every finished trial.

    Raises
    ------
    LearnError
        It says why nothing was learned.
    """
    before = _known_before(study)
    # From here on, no other process writes to the folder.
    study.open()
    stored, learned = stored_runs(study.folder), LearnedDrives.read(study.folder)
    model, earlier = _content(study.model_path), learned
    if drive.begun:
        earlier = learned.without(drive.name)
    else:
        learned.adding(drive.entry, drive.sequences).write()
    try:
        with_drive = _with(drive, reload())
        training = train(with_drive, progress)
    except Exception as error:
        told = isinstance(error, AdaptuneError)
        stays = drive.begun and (not told or isinstance(error, OSError))
        if _content(study.model_path) != model:
            said = f"The error model has been fitted with {drive.name}, which stays"
        elif stays:
            said = f"{drive.name} stays among the training sequences; run this again to go on"
        else:
            earlier.write()
            said = (
                f"Nothing was learned from {drive.name}, and the study is as it was; finished "
                f"trials are kept"
            )
        if not told and not isinstance(error, OSError):
            raise
        raise LearnError(f"{error}\n{said}") from error
    judged = *training.references, *training.doubts
    after = changes(before, Known.of(with_drive, training.model))
    words = [*after, *judged, runs_in_words(stored, stored_runs(study.folder))]
    return Lesson(with_drive, training, words)


def _with(drive: NewDrive, study: OfflineStudy) -> OfflineStudy:
    """The study, which must train on the drive."""
    if drive.name not in study.config.training:
        raise LearnError("-o training=...: names all training sequences; leave it out")
    return study


def _content(path: Path) -> bytes | None:
    """What a file holds; None if there is none."""
    return path.read_bytes() if path.exists() else None


def _known_before(study: OfflineStudy) -> Known | None:
    """What is known so far; None without a model, or with one that is not this study's."""
    try:
        return Known.of(study, ErrorModel.load(study.model_path))
    except (ModelError, ModeError):
        return None


def stored_runs(folder: Path) -> set[tuple[str, str]]:
    """Sequence and file name of every trial and every whole run in a study's folder."""
    found = (path for path in (folder / "trials").glob("*/*.npz") if path.stem[0].isdigit())
    return {(path.parent.name, path.stem) for path in found}


def runs_in_words(before: Collection[tuple[str, str]], after: Collection[tuple[str, str]]) -> str:
    """How many runs were made, on which sequences, and how many were there."""
    new = set(after) - set(before)
    said = []
    for name in sorted({name for name, _ in new}):
        stems = [stem for of, stem in new if of == name]
        trials = sum(stem.isdigit() for stem in stems)
        counts = {"trial": trials, "whole run": len(stems) - trials}
        kinds = [f"{n} {kind}{'s' if n > 1 else ''}" for kind, n in counts.items() if n]
        said.append(f"{' and '.join(kinds)} on {name}")
    there = f"{len(set(after) & set(before))} runs were there already"
    return f"Run: {'; '.join(said)}; {there}." if said else f"Nothing was run: {there}."


def changes(before: Known | None, after: Known) -> list[str]:
    """What is another one than before, a sentence each: fixed set, what is driven, its gain."""
    said = [_fixed_set(before, after), _what_is_driven(before, after), *_gains(before, after)]
    if before is not None and after.n_sets < before.n_sets:
        # As `offline.hours` does: it counts the trials on the drive.
        said.append(
            f"{after.n_sets} parameter sets were compared, and {before.n_sets} before: the search "
            f"ended earlier, by a budget that counts the new trials, too; raise it (offline)"
        )
    return said


def _fixed_set(before: Known | None, after: Known) -> str:
    now = f"{_trial(after.fixed)}: {_values(after.parameters)}"
    if before is None:
        return f"Fixed set: {now}."
    if before.fixed == after.fixed:
        return f"Fixed set: still {now}."
    differing = [
        f"{name} was {_value(before.parameters[name])}, is {_value(value)}"
        for name, value in after.parameters.items()
        if before.parameters.get(name, value) != value
    ]
    was = f"was {_trial(before.fixed)}, is {_trial(after.fixed)}"
    return f"Fixed set: {was}; {', '.join(differing)}."


def _trial(number: int) -> str:
    return f"trial {number}" if number else "trial 0, the baseline"


def _value(value: Value) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _values(parameters: ParameterSet) -> str:
    return ", ".join(f"{name} {_value(value)}" for name, value in parameters.items())


def _what_is_driven(before: Known | None, after: Known) -> str:
    now = _driven(after)
    if before is None:
        return f"Driven: {now}."
    if (was := _driven(before)) == now:
        return f"Driven: still {now}."
    said = f"Driven: was {was}, is {now}"
    if before.way == after.way == BANK:
        for what, some, others in (
            ("new", after.members, before.members),
            ("no longer a member", before.members, after.members),
        ):
            if numbers := [str(n) for n in some if n not in others]:
                said += f"; {what}: {', '.join(numbers)}"
    return f"{said}."


def _driven(known: Known) -> str:
    if known.way == BANK:
        return f"the bank of trials {', '.join(map(str, known.members))}"
    return "the fixed set" if known.way is None else "one set at a time"


def _gains(before: Known | None, after: Known) -> list[str]:
    """What is expected of what is driven, before and now."""
    now = _gain(after)
    if before is None:
        return [f"Expected: {now}."]
    was = _gain(before)
    return (
        [f"Expected: still {now}."]
        if was == now
        else [f"Expected before: {was}.", f"Expected now: {now}."]
    )


def _gain(known: Known) -> str:
    ways = [known.way] if known.way is not None else [BANK, ONE_SET]
    expected = {way: known.expected[way] for way in ways if way in known.expected}
    if not expected:
        return "unknown, there is too little to compare ways to adapt"
    best = min(expected, key=lambda way: expected[way]["loss"])
    words = expected_in_words(expected[best])
    if known.way is not None:
        return words
    name = "a bank" if best == BANK else "one set at a time"
    return f"no gain, the fixed set is driven (the best alternative is {name}: {words})"
