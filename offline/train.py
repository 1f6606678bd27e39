"""The offline stage: run the trials, choose the fixed set, fit the error model."""

import contextlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from adaptune import __version__
from adaptune._system import manifest, yaml12
from adaptune._system.files import write_text
from adaptune._system.machine import available, spare_memory
from adaptune._system.progress import Progress, unseen
from adaptune.errors import AdaptuneError
from adaptune.metrics import cap, span
from adaptune.model import ErrorModel, ModelError
from adaptune.model.registry import ADAPTIVE
from adaptune.model.rules import best_sets, complementary
from adaptune.odometry.registry import ODOMETRIES, PROGRAMS
from adaptune.paired import Pair, Ratio, in_cell, ratio
from adaptune.report import tables
from adaptune.runs.archive import Archive, TrialSummary
from adaptune.space import ParameterSet, ParameterSets, in_words
from adaptune.study.config import SwitchingConfig
from adaptune.study.driven import ANY, COST, EQUAL, FILES, lost_in_words
from adaptune.study.references import (
    ensure_references,
    estimates_in_words,
    estimates_of,
)
from adaptune.study.study import FIXED_SET
from offline.bank_choice import choose, recommends_bank, reserve
from offline.campaign import (
    Campaign,
    Schedule,
    forecast,
    run_baseline,
)
from offline.choice import NothingUsableError
from offline.config import OfflineConfig, OfflineStudy
from offline.drive import TrialSetup
from offline.front import front_rows, in_short, left_out
from offline.labelled import LabelledData, labelled_data, with_vectors
from offline.objective import (
    JudgedSet,
    baseline_words,
    failed_in_words,
    label,
    unread_in_words,
    weighted,
)
from offline.search import BUDGETS, ELAPSED, Finished, Stopwatch
from offline.trial_table import of_each, rows
from offline.whole import bare_in_words, drive_whole, in_whole_drives
from offline.workers import Cluster, Pool, Workers

_log = logging.getLogger(__name__)


class Training(NamedTuple):
    """Result of the offline stage."""

    model: ErrorModel
    trials: list[dict[str, Any]]  # a row each, as in trials.csv
    # For every training sequence what the baseline, the fixed set and its own best set do there.
    rows: list[dict[str, Any]]
    said: Sequence[str] = ()  # further sentences
    # Sentences if some sets failed, were not tried in time, or all gave the same poses.
    failed: Sequence[str] = ()
    # What error costs, a row for each choice, that which is recommended first.
    front: Sequence[dict[str, Any]] = ()

    @property
    def words(self) -> list[str]:
        """What must be known of the trials, and the parameters of fixed set and baseline."""
        sets, fixed = self.model.sets, self.model.fixed
        said = [*self.said, *self.failed]
        if fixed:
            said.append(f"Parameters of the fixed set: {in_words(sets[fixed])}")
        else:
            said.append("No set within the budget is safely better than the baseline in training.")
        return [*said, f"Parameters of the baseline: {in_words(sets.space.baseline)}"]


def train(
    study: OfflineStudy,
    progress: Progress = unseen,
    cluster: str | None = None,
    clock: Stopwatch | None = None,
) -> Training:
    """Estimate the references that are lacking, run the trials that are, and fit the model.

    The study's folder receives the archive, the error model, the fixed set (see `write_sets`),
    and tables of the trials (``trials``) and of the training sequences (``training``). `cluster`
    is the address of a Dask scheduler whose workers run the trials. Trials of other inputs than
    now are run again. `offline.hours` are those of the `clock`, by default those of this call.
    There is an AdaptuneError if a sequence, its reference or the odometry cannot be used, or no set
    gives poses.
    """
    if not any(study.odometry.space.baselines):
        raise AdaptuneError("odometry.parameters: is empty, so there is nothing to tune; name some")
    clock = clock or Stopwatch(study.folder / ELAPSED)
    archive = _ready_archive(study, progress)
    config, names, space = study.config.offline, study.training, study.odometry.space
    with trial_workers(study, names, cluster) as workers:
        done, ended = _searched(study, archive, workers, progress, clock)
        finished = {name: {n: archive.finished(name)[n] for n in done} for name in names}
        tried = tuple(one.parameters for one in done.values())
        every_set = ParameterSets(space, tuple(done), tried)
        data = labelled_data(study, archive, every_set)

        def drive(data: LabelledData) -> None:
            sets = {n: every_set[n] for n in sorted({*data.finalists(), *every_set.defaults})}
            drive_whole(study, sets, archive, workers, progress)

        judged = data.usable()
        usable = in_whole_drives(judged, archive, config, drive)
    whole = archive.summaries(names, [*usable.finalists(), *every_set.defaults])
    fixed, equal_cost, any_cost = usable.front()[1:4]
    dropped = sorted({*judged.sets} - {*usable.sets})
    data = data._replace(costs=(usable.beside or data.costs).without(dropped))
    model = _fit_and_save(study, data, with_vectors(usable, archive), finished, fixed)
    write_sets(study, every_set[fixed], {EQUAL: every_set[equal_cost], ANY: every_set[any_cost]})
    trials = _trial_rows(config, rows(archive, names), done)
    tables.write_rows(study.folder, "trials", trials)
    estimates = estimates_of(study.sequences, names)
    in_training = _training_rows(usable, finished, fixed, whole, config)
    tables.write_rows(study.folder, "training", in_training)
    best = f"the fixed set, the best of {len(trials)} parameter sets,"
    said = lost_in_words(study, best, {row["sequence"]: row["fixed, whole"] for row in in_training})
    said += estimates_in_words(estimates, model.length)
    said += baseline_words(config, [of[0] for of in finished.values()])
    of_bare, worse = bare_in_words(archive, whole, fixed, dropped)
    said += of_bare
    rows_of_front = front_rows(usable, model, left_out(judged, usable, model, worse))
    tables.write_rows(study.folder, "front", rows_of_front)
    failed = [*ended, *unread_in_words(finished), *failed_in_words(done)]
    return Training(model, trials, in_training, said, failed, rows_of_front)


def _left_out(others: LabelledData, drives: Mapping[int, TrialSummary]) -> float | None:
    """Error on a sequence, whose drives these are, of the set that other recordings choose."""
    with contextlib.suppress(NothingUsableError):
        if others.sequences and (drive := drives.get(others.fixed())):
            return drive.mean_error
    return None


def _searched(
    study: OfflineStudy, archive: Archive, workers: Pool[Any], progress: Progress, clock: Stopwatch
) -> tuple[dict[int, JudgedSet], list[str]]:
    """Drive the baseline, say how long the rest takes, and try sets; what time has left out."""
    run_baseline(study, archive, workers, progress)
    expected, config = forecast(study, archive, len(workers.workers()), clock), study.config.offline
    left = (config.most_trials or np.inf) - min(len(archive.finished(n)) for n in study.training)
    most = 3600.0 * ((config.hours or np.inf) - clock.hours)
    if left > 0 and most > 0.0 and min(left, most) < np.inf:
        _log.info("%s", expected.words(left, most))
    tell = partial(_say_so_far, study, archive)
    campaign = Campaign(study, archive, workers, progress, clock, expected, tell)
    return campaign.run(), campaign.words


def _say_so_far(study: OfflineStudy, archive: Archive, judged: Mapping[int, JudgedSet]) -> None:
    """Say what the sets of the portfolio recommend, before others are tried."""
    tried = tuple(one.parameters for one in judged.values())
    sets = ParameterSets(study.odometry.space, tuple(judged), tried)
    try:
        said = in_short(labelled_data(study, archive, sets).usable())
    except AdaptuneError as why:  # what follows may be usable, or within the budget
        said = f"so far, none can be recommended ({why})"
    _log.info("after %d sets: %s; the search goes on", len(tried), said)


def _ready_archive(study: OfflineStudy, progress: Progress) -> Archive:
    """The archive without trials of other inputs than now; references are there, or estimated."""
    if unjudged := study.sequences.unjudged(study.training):
        raise AdaptuneError(
            f"{study.sequences.key(unjudged[0])}: training needs a reference trajectory; name its "
            f"topic or file, or leave `reference` out to have it estimated"
        )
    study.open()
    length = study.config.sub_trajectory
    ensure_references(study.sequences, study.training, length, progress)
    archive = study.archive()
    archive.begin()
    # Where nothing has been run, the search's time begins anew.
    for path in () if archive.known() else study.folder.glob("elapsed*.json"):
        path.unlink()
    archive.tidy()
    return archive


def write_sets(
    study: OfflineStudy,
    fixed: ParameterSet,
    others: Mapping[str, ParameterSet] = MappingProxyType({}),
) -> None:
    """Write the fixed set (``fixed.yaml``), and again as its odometry's own tool reads it, if any.

    The latter is ``fixed_<odometry>``, with a suffix. That of another odometry is removed. Of the
    `others`, the best at no more CPU time and at any, each has its file, see `FILES`, unless it is
    the fixed set.
    """
    own = study.own_file(fixed)
    ours = {f"fixed_{name}" for name in (*ODOMETRIES, *PROGRAMS)}
    for path in study.folder.glob("fixed_*"):
        if path.stem in ours and (own is None or path != own[0]):
            path.unlink()
    write_text(study.folder / FIXED_SET, yaml12.dump(fixed))
    if own is not None:
        write_text(own[0], own[1].text)
    for role in (EQUAL, ANY):
        path = study.folder / FILES[role]
        if others.get(role, fixed) != fixed:
            write_text(path, yaml12.dump(others[role]))
        else:
            path.unlink(missing_ok=True)


def trial_workers(
    study: OfflineStudy, names: Sequence[str], cluster: str | None
) -> Cluster | Workers:
    """Processes of this machine, or of a cluster, that run trials on some sequences."""
    config = study.config.offline
    n = config.workers or available()
    where = cluster or f"{n} worker{'s' if n > 1 else ''}"
    _log.info("trials run on %s; each sequence is prepared before its first one", where)
    odometry = study.odometry.changed(user_code=True)
    setup = TrialSetup(study.config, odometry, study.sequences)
    return Cluster(setup, names, cluster) if cluster else Workers(setup, n, spare_memory())


def _fit_and_save(
    study: OfflineStudy, data: LabelledData, usable: LabelledData, finished: Finished, fixed: int
) -> ErrorModel:
    """The study's error model: the one before, if that was fitted to just this, or fitted now."""
    config, inputs = study.config, study.model_inputs
    settings = config.offline.model_dump(mode="json", exclude={*BUDGETS, "workers"})
    versions = {"adaptune": __version__, "numpy": np.__version__} | study.odometry.content
    provenance = {"versions": versions} | settings | {"inputs": manifest.digest(inputs)}

    def evidence(trial: TrialSummary) -> tuple[Any, ...]:
        value = weighted(config.offline.objective, trial.metrics)
        return trial.mean_error, trial.restarts, (trial.parameters, value, trial.failure)

    trials = {name: {n: evidence(run) for n, run in of.items()} for name, of in finished.items()}
    switching = config.online.switching.model_dump(mode="json", include={"size"})
    online = (config.online.period, config.online.budget, data.cores, switching)
    provenance["evidence"] = manifest.digest((trials, online, fixed))
    model = None
    with contextlib.suppress(ModelError):
        model = ErrorModel.load(study.model_path)
    if model is None or model.provenance != provenance:
        identity, length = study.odometry.identity, config.sub_trajectory
        model = fit(data, fixed, identity, length, study.window, provenance)
        model = replace(model, budget=config.online.budget, milliseconds=data.budget)
        model = with_bank(model, usable, config.online.switching)
        model.save(study.model_path)
    manifest.record(study.model_inputs_path, inputs)
    return model


def _trial_rows(
    config: OfflineConfig, table: Sequence[dict[str, Any]], judged: Mapping[int, JudgedSet]
) -> list[dict[str, Any]]:
    """A row for every trial: as `adaptune trials` lists it, and how it was judged."""
    rows = []
    for row in table:
        if (tried := judged.get(row["trial"])) is None:
            continue
        row[COST] = row.pop("cost")
        row["state"] = tried.state
        if set(config.objective) != {"rte"}:
            row[label(config.objective)] = tried.value
        rows.append(row)
    return rows


def _training_rows(
    usable: LabelledData,
    finished: Finished,
    fixed: int,
    whole: Finished,
    config: OfflineConfig,
) -> list[dict[str, Any]]:
    """A row for every training sequence, with the set that has the least error there."""
    rows = []
    for sequence in usable.sequences:
        name, trials = sequence.name, finished[sequence.name]
        sound = (trial for trial in trials.values() if not trial.failure)
        best = min(sound, key=lambda trial: weighted(config.objective, trial.metrics))
        rows.append(
            {
                "sequence": name,
                "baseline": trials[0].mean_error,
                "fixed": trials[fixed].mean_error,
                "own best": best.mean_error,
                "restarts, baseline": round(trials[0].restarts),
                "restarts, fixed": round(trials[fixed].restarts),
                "baseline, whole": whole[name][0].mean_error,
                "fixed, whole": whole[name][fixed].mean_error,
                "_left out": _left_out(usable.without(sequence), whole[name]),
            }
        )
    return rows


def fit(
    data: LabelledData,
    fixed: int,
    odometry: dict[str, Any],
    length: float,
    window: int,
    provenance: dict[str, Any],
) -> ErrorModel:
    """Make the error model, which does not adapt yet."""
    sequences = data.sequences
    return ErrorModel(
        odometry=odometry,
        sets=data.sets,
        fixed=fixed,
        length=length,
        sequences=[s.name for s in sequences],
        blocks=dict(sequences[0].blocks),
        window=window,
        descriptors=np.concatenate([s.descriptors for s in sequences]),
        sequence=data.numbers(),
        errors=data.errors(),
        elevations=[s.elevation for s in sequences],
        provenance=provenance,
        segment=np.concatenate([s.segment for s in sequences]),
        costs=data.costs,
    )


def with_bank(model: ErrorModel, usable: LabelledData, switching: SwitchingConfig) -> ErrorModel:
    """Choose the bank and the settings of its weights, and whether it is recommended."""
    chosen = choose(usable, switching.size)
    members = chosen.members or [model.fixed]
    besides = reserve(members, usable)
    expected = {} if chosen.expected is None else chosen.expected._asdict()
    members = [*members, *besides]
    return replace(
        model,
        bank=members,
        bank_size=switching.size,
        vectors=usable.vectors(members),
        bank_settings=chosen.bank.model_copy(update={"reserve": len(besides)}),
        # As they are read back, so that the same model is the same file.
        expected={key: float(x) for key, x in expected.items()},
        recommended=ADAPTIVE if recommends_bank(usable, chosen, model.fixed) else "fixed",
    )


def run_oracle(
    study: OfflineStudy,
    n_sets: int = 16,
    progress: Progress = unseen,
    cluster: str | None = None,
) -> list[dict[str, Any]]:
    """Run some of the model's sets as trials on the test sequences, unless that was done before.

    ``oracle`` in the study's folder receives the trials, which no model is fitted to. There is an
    AdaptuneError if there is no model of the study, or no test sequence has a reference.

    Returns for every test sequence the errors of the fixed set and of the best one, in percent.
    """
    model = study.model()
    archive, names = _on_test(study, model, oracle_sets(model, n_sets), progress, cluster)
    return [_oracle_row(name, archive.errors_of(name, model.sets), model.fixed) for name in names]


def _on_test(
    study: OfflineStudy,
    model: ErrorModel,
    numbers: Sequence[int],
    progress: Progress,
    cluster: str | None,
    kind: Literal["oracle", "odometries"] = "oracle",
) -> tuple[Archive, list[str]]:
    """Run sets as trials on the test sequences with a reference; where they are, and on which."""
    study.open()
    names, archive = _ensure_test_references(study, progress), study.archive(kind)
    archive.begin()
    archive.tidy()
    schedule = Schedule(study, archive, "runs on test sequences", progress, measure=False)
    for name in names:
        schedule.need(name)
        for n in numbers:
            trial = archive.finished(name).get(n)
            if trial is None or trial.parameters != model.sets[n]:
                schedule.add(name, n, model.sets[n])
    if schedule.waits():
        with trial_workers(study, names, cluster) as workers:
            for done in schedule.run(workers):
                schedule.store(*done)
        schedule.close()
    return archive, names


def run_odometries(
    study: OfflineStudy,
    training: Training,
    progress: Progress = unseen,
    cluster: str | None = None,
) -> list[dict[str, Any]]:
    """What each of several odometries has with its own parameters and tuned, the best first.

    These sets run as trials on the test sequences, for which ``odometries`` in the study's folder
    is. Ratios, with 95 % intervals, are to the baseline's error. No rows for a single odometry.
    """
    labels, model, rows = list(study.config.odometries), training.model, list[dict[str, Any]]()
    for one, (own, best) in of_each(training.trials).items():
        for row in [own] + [best] * (best is not own):
            which = "its own parameters" if row is own else f"trial {row['trial']}"
            about = {"odometry": one, "set": which, "training [%]": row["mean"]}
            rows.append(about | {COST: row[COST], "_trial": row["trial"], "_state": row["state"]})
    if not rows:
        return []
    known = [row["_trial"] for row in rows if row["_state"] == "complete"]
    archive, names = _on_test(study, model, known, progress, cluster, "odometries")
    pairs: dict[int, list[Pair]] = {trial: [] for trial in known}
    for name in names:
        errors = {n: cap(of) for n, of in archive.errors_of(name, model.sets).items()}
        block = span(archive.read_frames(name).counted, model.length)
        for trial, of in pairs.items():
            both = np.stack([errors[trial], errors[known[0]]])
            both = both[:, ~np.isnan(both).any(axis=0)]
            if both.size:
                of.append(Pair(both, block, study.sequences.recorded_in(name)))
    for row in rows:
        of = pairs.get(row["_trial"], [])
        row["test [%]"] = float(np.mean([p.errors[0].mean() for p in of])) if of else None
        value, ends, _ = ratio(of) if of else Ratio(np.nan)
        row[f"vs {labels[0]}'s own"] = value if of else None
        row["95 %"] = in_cell(ends) if of else None
    return sorted(rows, key=lambda row: (row["test [%]"] is None, row["test [%]"] or 0.0))


def oracle_sets(model: ErrorModel, n: int) -> list[int]:
    """Trial numbers of some of a model's complete sets.

    The fixed set, the members of the bank, sets that complement each other (see `complementary`),
    and, where these are too few, those with the least training error.
    """
    data = model.training_data(model.pca())
    allowed = {trial for trial, may in zip(data.sets, data.allows(), strict=True) if may}
    best = [t for t in best_sets(data.errors, data.sequence, data.sets) if t in allowed]
    chosen = dict.fromkeys([model.fixed, *model.bank, *complementary(data, n), *best])
    return list(chosen)[:n]


def _ensure_test_references(study: OfflineStudy, progress: Progress) -> list[str]:
    """The test sequences that have a reference, or get an estimated one."""
    test, length = study.config.test, study.config.sub_trajectory
    refused = ensure_references(study.sequences, test, length, progress, required=False)
    for name, said in refused.items():
        _log.warning("%s; so %s is left out", said, name)
    without = {*refused, *study.sequences.unjudged(test)}
    names = [name for name in test if name not in without]
    if not names:
        raise AdaptuneError(
            "test: name at least one sequence with a reference; without one, nobody knows which "
            "set was best"
        )
    return names


def _oracle_row(name: str, errors: Mapping[int, NDArray[np.float32]], fixed: int) -> dict[str, Any]:
    means = {n: float(np.nanmean(cap(of))) for n, of in errors.items()}
    best = min(means, key=means.__getitem__)
    return {
        "sequence": name,
        "fixed": means[fixed],
        "best": means[best],
        "best / fixed": means[best] / means[fixed],
        "trial": best,
        "sets": len(means),
    }
