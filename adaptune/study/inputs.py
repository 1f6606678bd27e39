"""What a study's results depend on: noted beside its trials, and compared when it is resumed."""

import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import __version__
from adaptune.archive import Archive
from adaptune.files import write_text
from adaptune.model import ErrorModel
from adaptune.model.descriptor import descriptor_content
from adaptune.recording.cache import MANY, status_key
from adaptune.strict import ConfigurationError
from adaptune.study.study import Study, differences

FILE = "inputs.json"
"""In the folder of a sequence's trials: what they depend on."""
AGAIN = "`adaptune offline --again` with this study"

_log = logging.getLogger(__name__)


class Stale(NamedTuple):
    """A sequence whose trials depend on something that has changed."""

    name: str
    changes: Sequence[str]  # what has changed, in words
    odometry: bool  # whether this concerns all sequences
    trials: Sequence[int] | None = None  # which of its trials; None for all


class InputNotes:
    """Notes what the trials of a sequence depend on, before the first of them is stored."""

    def __init__(self, study: Study):
        self._study = study
        # What runs is what is there now, whatever becomes of the files.
        self._odometry, self._descriptors = odometry_inputs(study), described_by(study)
        lacking = [name for name in study.training if not _path(study, name).exists()]
        self._statuses = {name: _statuses(study, name) for name in lacking}

    def __call__(self, name: str) -> None:
        """Write the note of a sequence, if it has none.

        Raises
        ------
        ConfigurationError
            If a file of the sequence has changed since this was made: what was read is not known.
        """
        path = _path(self._study, name)
        if path.exists():
            return
        now, before = _statuses(self._study, name), self._statuses.get(name)
        if before is not None and now != before:
            changed = next(iter(dict(now.items() ^ before.items())))
            raise ConfigurationError(
                f"{changed}: has changed while {name} was read, and nothing on {name} is stored; "
                f"run the same command again"
            )
        of_sequence = self._study.sequences.identity(name) | self._study.sequences.reference(name)
        about = {"adaptune": __version__, "odometry": self._odometry}
        about |= {"descriptors": self._descriptors}
        write_text(path, json.dumps(about | of_sequence, indent=1) + "\n")


def _statuses(study: Study, name: str) -> dict[Path, str]:
    """By file of a sequence, what shows that it is the same as before."""
    files = study.sequences.files(name)
    return {file: status_key(file) for file in (*files.recording, *files.reference)}


def odometry_inputs(study: Study) -> dict[str, Any]:
    """Everything about the odometry that trials and replays depend on, as plain data."""
    odometry = study.odometry
    about = {
        **odometry.identity,
        "parameters": odometry.space.dump(),
        "content": odometry.content,
    }
    if odometry.apart:
        about["limits"] = study.config.isolation.model_dump()
    plain: dict[str, Any] = json.loads(json.dumps(about))
    return plain


def described_by(study: Study) -> dict[str, str]:
    """What the user's descriptors depend on."""
    return descriptor_content(study.config.descriptor)


def stale(study: Study) -> list[Stale]:
    """The sequences whose stored trials depend on something that has changed since.

    Of sequences that are not trained on at present, only the odometry is compared.

    Raises
    ------
    ConfigurationError
        If a note is damaged.
    """
    now, found = odometry_inputs(study), []
    for folder in sorted((study.folder / "trials").glob("*/")):
        name = folder.name
        before = _read(study, name)
        if before is None:
            if n_trials(study, name):
                what = f"{folder} holds trials of an older adaptune, which did not note their input"
                found.append(Stale(name, [what], odometry=False))
            continue
        changes = list(_odometry_changes(before["odometry"], now))
        odometry = bool(changes)
        if name in study.training:
            changes += _sequence_changes(study, name, before)
        if changes:
            found.append(Stale(name, changes, odometry))
        elif keys := sorted(_other_limits(before["odometry"], now)):
            runs = Archive(study.folder / "trials").finished(name)
            if faulty := [n for n, run in runs.items() if run.faults]:
                values = [f"isolation.{key} has another value" for key in keys]
                found.append(Stale(name, values, odometry=False, trials=faulty))
    return found


def check_inputs(study: Study) -> None:
    """Refuse a study whose stored trials depend on something that has changed since.

    Raises
    ------
    ConfigurationError
        It says what has changed, which results depend on it, and what to do.
    """
    if found := stale(study):
        raise _refusal(study, found)


def _refusal(study: Study, found: Sequence[Stale]) -> ConfigurationError:
    """What has changed, which results depend on it, and what to do."""
    changes = dict.fromkeys(change for one in found for change in one.changes)
    results = [
        f"{n_trials(study, one.name)} trials on {one.name}"
        if one.trials is None
        else f"{len(one.trials)} trials with faults on {one.name}"
        for one in found
    ]
    results += ["the model"] if study.model_path.exists() else []
    everything = any(one.odometry for one in found)
    kept = study.folder / "replays"
    replays = [
        path
        for path in kept.rglob("replay.json")
        if everything or path.relative_to(kept).parts[1] != "baseline"
    ]
    results += [f"{len(replays)} replays"] if replays else []
    return ConfigurationError(
        f"{study.folder}: {'; '.join(changes)}. On this depend {', '.join(results)}. {AGAIN} "
        f"computes them again, and nothing else; or give this study another folder (--folder)"
    )


def warn_of_stale(study: Study) -> None:
    """Log what `check_inputs` refuses, where old results may still be looked at."""
    try:
        check_inputs(study)
    except ConfigurationError as error:
        _log.warning("%s", error)


def check_model(study: Study, sequences: Sequence[str], provenance: Mapping[str, Any]) -> None:
    """Refuse a model of the study's own that was fitted to other input than there is now.

    Parameters
    ----------
    study
        The study.
    sequences, provenance
        Of the model.

    Raises
    ------
    ConfigurationError
        It says what has changed, and what to do.
    """
    check_inputs(study)
    why = ""
    if list(sequences) != study.training:
        why = "other training sequences"
    elif any(_other_descriptors(study, name) for name in study.training):
        why = f"another {' and '.join(described_by(study))}"
    elif provenance.get("inputs") != digest(study):
        why = "other trials"
    if why:
        raise ConfigurationError(
            f"{study.model_path}: was fitted to {why} than the study has now; run `adaptune "
            f"offline` again"
        )


def digest(study: Study) -> str:
    """Digest of what is noted for all training sequences."""
    notes = {name: _read(study, name) or {} for name in study.training}
    kept = {name: {k: v for k, v in n.items() if k != "adaptune"} for name, n in notes.items()}
    return hashlib.blake2b(json.dumps(kept).encode(), digest_size=16).hexdigest()


def resume(study: Study, again: bool = False) -> None:
    """Open the study's folder, and remove what has to be made again.

    Parameters
    ----------
    study
        The study.
    again
        Remove the trials that depend on something that has changed, instead of refusing them.

    Raises
    ------
    ConfigurationError
    """
    found = stale(study)
    if found and not again:
        raise _refusal(study, found)
    study.open()
    _remove_stale(study, found)
    _remove_other_descriptions(study)


def _remove_stale(study: Study, found: Sequence[Stale]) -> None:
    """Remove the trials that depend on something that has changed."""
    for one in found:
        folder = study.folder / "trials" / one.name
        if one.trials is not None:
            for path in (path for n in one.trials for path in folder.glob(f"{n:05d}*.npz")):
                path.unlink()
            note = _read(study, one.name) or {}
            note["odometry"] |= {"limits": odometry_inputs(study).get("limits")}
            write_text(folder / FILE, json.dumps(note, indent=1) + "\n")
            continue
        # The note goes last: until then, the trials are known to be stale.
        for path in (*folder.glob("*.npz"), folder / FILE):
            path.unlink(missing_ok=True)
    for path in study.folder.glob("optuna.log*") if found else ():
        path.unlink()  # it is written again
    if found and not any((study.folder / "trials").glob("*/*.npz")):
        for path in study.folder.glob("elapsed*.json"):
            path.unlink()


def _remove_other_descriptions(study: Study) -> None:
    """Remove the frames that another version of a user's descriptor has described."""
    for name in study.training:
        note = _read(study, name)
        if note is not None and _other_descriptors(study, name):
            (study.folder / "trials" / name / "frames.npz").unlink(missing_ok=True)
            note["descriptors"] = described_by(study)
            write_text(_path(study, name), json.dumps(note, indent=1) + "\n")


def n_trials(study: Study, name: str) -> int:
    """Number of stored trials on a sequence."""
    return len(list((study.folder / "trials" / name).glob("*[0-9].npz")))


def _other_descriptors(study: Study, name: str) -> bool:
    note, now = _read(study, name), described_by(study)
    known = {} if note is None else note["descriptors"]
    return any(known.get(what, of) != of for what, of in now.items())


def _path(study: Study, name: str) -> Path:
    return study.folder / "trials" / name / FILE


def _read(study: Study, name: str) -> dict[str, Any] | None:
    path = _path(study, name)
    try:
        note = dict(json.loads(path.read_text(encoding="utf-8")))
        parts = (note["odometry"]["content"], note["sequence"], note["descriptors"])
        if all(isinstance(part, dict) for part in parts):
            return note
        error: Exception = TypeError("it lacks a part")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as problem:
        error = problem
    raise ConfigurationError(
        f"{path}: is damaged ({error}); remove the folder {path.parent} and run `adaptune offline`"
    )


def _odometry_changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    if before["name"] != now["name"]:
        yield f"odometry.name is {now['name']}, and was {before['name']}"
        return
    for part in ("settings", "parameters"):
        for key in sorted(differences(before.get(part), now[part])):
            yield f"odometry.{part}.{key} has another value"
    for what in sorted({*before["content"], *now["content"]}):
        was, is_ = before["content"].get(what), now["content"].get(what)
        if was == is_:
            continue
        if what.startswith("version of"):
            yield f"the {what} is {is_}, and was {was}"
        else:
            yield f"{what} has other content than when the trials were run"


def _other_limits(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterable[str]:
    """Limits on the odometry's processes that differ; only trials with faults depend on them."""
    limits = now.get("limits")
    return differences(before.get("limits", limits), limits)


def _sequence_changes(study: Study, name: str, before: Mapping[str, Any]) -> Iterator[str]:
    sequences, files = study.sequences, study.sequences.files(name)
    now = sequences.identity(name) | sequences.reference(name)
    for what, of in (("recording", files.recording), ("reference", files.reference)):
        for file in _other_files(before.get(what) or [], now[what], of):
            yield f"{file} has other content than when {name} was trained on"
    kind = "sequences" if now["course"] is None else "courses"
    for part in ("sequence", "course", "poses"):
        for key in sorted(differences(before.get(part), now[part])):
            yield f"{kind}.{name}.{key} has another value"


def _other_files(before: Sequence[str], now: Sequence[str], files: Sequence[Path]) -> Iterable[Any]:
    if before == now:
        return []
    if len(before) == len(now) == len(files):
        return [f for f, a, b in zip(files, before, now, strict=True) if a != b]
    return files if 0 < len(files) < MANY else [files[0].parent if files else "the reference"]


# Trials on the test sequences, for what the best choice in hindsight would have been.
#
# `adaptune online --oracle` runs them into an archive of their own. Nothing learns from it.


class OracleErrors(NamedTuple):
    """Errors of several sets on a test sequence, as trials measure them.

    A trial restarts at the reference after a lost track. A replay does not.
    """

    stamps: NDArray[np.int64]  # (n_frames,): nanoseconds
    trials: tuple[int, ...]  # numbers of the sets, the fixed one's first if it is among them
    # (n_frames, n_sets): sub-trajectory RTE in percent, NaN without a sub-trajectory, infinite
    # where the track was lost.
    errors: NDArray[np.float32]


def oracle_archive(study: Study) -> Archive:
    """The archive of the trials on test sequences, which notes what they depend on."""
    archive = Archive(study.folder / "oracle")

    def note(name: str) -> None:
        path = archive.folder / name / FILE
        if not path.exists():
            write_text(path, json.dumps(_inputs(study, name), indent=1) + "\n")

    return Archive(archive.folder, note)


def _inputs(study: Study, name: str) -> dict[str, Any]:
    """Everything that trials on a sequence depend on, as plain data."""
    about = {"odometry": odometry_inputs(study)} | study.sequences.identity(name)
    plain: dict[str, Any] = json.loads(json.dumps(about | study.sequences.reference(name)))
    return plain


def oracle_changes(study: Study, name: str) -> list[str]:
    """What has changed since the trials on a test sequence were run; empty if nothing has.

    Without a note that can be read, nobody knows what they were run with.
    """
    folder = study.folder / "oracle" / name
    if not any(folder.glob("*.npz")):
        return []
    try:
        before = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return sorted(differences(before, _inputs(study, name)))
    except (OSError, ValueError, TypeError, AttributeError):
        return [FILE]


def read_oracle(study: Study, name: str, model: ErrorModel) -> OracleErrors | None:
    """The errors of a model's sets on a test sequence; None where the oracle ran none.

    Trials that were run with something else than the study has now are left out, with a warning.

    Parameters
    ----------
    study
        The study.
    name
        Of the test sequence.
    model
        The sets are those of the model that were run.

    Raises
    ------
    ArchiveError
        If a file is damaged.
    """
    if changes := oracle_changes(study, name):
        _log.warning(
            "%s: the oracle's trials were run with another %s; run `adaptune online --oracle` "
            "again",
            name,
            ", ".join(changes),
        )
        return None
    archive = oracle_archive(study)
    finished = archive.finished(name)
    known = [t for t in model.sets if t in finished and finished[t].parameters == model.sets[t]]
    if not known:
        return None
    trials = tuple(sorted(known, key=lambda trial: (trial != model.fixed, trial)))
    stamps = archive.read_frames(name).stamps
    return OracleErrors(stamps, trials, archive.read_errors(name, trials))
