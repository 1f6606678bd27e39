"""What selection gains on simulated sequences that were left out.

    python benchmarks/gain.py runs/gain --seeds 10 11    # hours on one core; resumes
    python benchmarks/gain.py runs/gain --seeds 10 --odometries gicp --ablate | --curve | ...

Each seed is another world: 24 sequences (4 caves, 4 streets, 4 open, 4 gardens, of 120 m each, and
8 mixed ones of three scenes, each 0.4 times as long) on which keyframe GICP and NDT run the same
parameter sets. One sequence after the other is left out, and the fixed set, the rules and their
settings are fitted on the other 23. What is printed are ratios to the fixed set's error. The rule
was worked out on GICP with seeds 0, 4 and 5, and changed after seeds 7 (GICP and NDT), 8 and 9; the
bank on GICP with seeds 7, 9, 11 and 12, and NDT with seed 8.
"""

import argparse
import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Self
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray
from offline.fusion import Drive, error_vectors, periods, recorded_motions
from offline.validation import (
    BANK_SIZE,
    NO_WORSE,
    LabelledSequence,
    Maker,
    Validation,
    choose_bank,
    learning_curve,
    leave_one_out,
    training_data,
    tune,
    tune_bank,
)

from adaptune.archive import Frames
from adaptune.descriptor import DESCRIPTORS, averaged, descriptor, lowest_elevation
from adaptune.descriptor.motion import MOTION, speed_and_turn_rate
from adaptune.descriptor.ndt_histogram import N_FEATURES, ndt_histogram
from adaptune.files import replacing
from adaptune.metrics import cap
from adaptune.model import (
    RULES,
    PairedExpectedRatio,
    PairedFusion,
    Rule,
    Selection,
    Settings,
    TrainingData,
    fusion,
)
from adaptune.model.base import complementary
from adaptune.odometry.factory import OdometryFactory
from adaptune.odometry.isolation import Limits
from adaptune.odometry.registry import odometry_class
from adaptune.simulation import Course
from adaptune.simulation.simulate import simulate
from offline.config import OfflineConfig
from offline.samplers import make_sampler
from offline.trial import TrialSettings, run_trials

ODOMETRIES = ("gicp", "ndt")
N_SETS = 16
KINDS = ("cave", "street", "open", "garden")
PER_KIND = 4
WINDOW = 3
"""Selections whose descriptors are averaged."""
PERIOD = 10
"""Scans from one selection to the next."""


def training_courses(seed: int, length: float) -> dict[str, Course]:
    """All courses by name; no world is shared with another seed's."""
    single = {
        f"{kind}{i}": Course(scenes=(kind,), length=length, seed=1000 * seed + 10 * k + i)
        for k, kind in enumerate(KINDS)
        for i in range(PER_KIND)
    }
    orders: tuple[tuple[str, ...], ...] = (
        ("cave", "open", "street"),
        ("street", "garden", "cave"),
        ("open", "cave", "garden"),
        ("garden", "street", "open"),
    )
    orders += tuple(scenes[::-1] for scenes in orders)
    mixed = {
        f"mixed{i}": Course(scenes=scenes, length=0.4 * length, seed=1000 * seed + 100 + i)
        for i, scenes in enumerate(orders)
    }
    return single | mixed


def factory_of(name: str) -> OdometryFactory:
    """An odometry with its default settings, all of whose parameters are tuned."""
    space: Any = getattr(odometry_class(name), "space", None)
    return OdometryFactory(name, {}, space, Limits())


class Prepared:
    """What `run_trials` passes over."""

    def __init__(self, name: str, prepared: list[Any], frames: Frames):
        self.name, self._prepared, self.frames = name, prepared, frames

    def __iter__(self) -> Any:
        return iter(self._prepared)


def run(path: Path, course: Course, odometry: str, seed: int) -> None:
    """Drive a course with all sets of an odometry, and keep the errors."""
    scans = list(simulate(course))
    frames = Frames(
        np.array([scan.stamp for scan in scans]),
        np.array([scan.T_world_sensor for scan in scans]),
        np.array([ndt_histogram(scan.points) for scan in scans], np.float32),
        {"ndt": N_FEATURES},
        np.array([lowest_elevation(scan) for scan in scans], np.float32),
    )
    factory, settings = factory_of(odometry), TrialSettings()
    config = OfflineConfig(sampler="sobol", batch=N_SETS, seed=seed)
    sets = make_sampler(factory.space, config).propose([])
    one = factory()
    prepared: Any = Prepared(path.stem, [one.prepare(scan) for scan in scans], frames)
    trials = run_trials(settings, factory, prepared, sets)
    length, lost_track = settings.sub_trajectory, settings.lost_track
    vectors = [error_vectors(frames, trial, length) for trial in trials]
    motions = recorded_motions(frames, trials, lost_track)[..., :3, :]
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez_compressed(
            file,
            stamps=frames.stamps,
            T_world_sensor=frames.T_ref_sensor,
            histograms=frames.descriptors.astype(np.uint16),
            sets=factory.space.to_unit(sets),
            errors=np.stack([trial.errors for trial in trials], axis=1).astype(np.float32),
            vectors=np.stack(vectors, axis=1),
            motions=motions.astype(np.float32),
        )


def trials(folder: Path, odometry: str, courses: dict[str, Course], seed: int) -> list[Path]:
    """Run what has not been run yet, and tell where it is."""
    paths = []
    for name, course in courses.items():
        path = folder / f"{odometry}-{seed}-{course.length:.0f}-{name}.npz"
        paths.append(path)
        if not path.exists():
            run(path, course, odometry, seed)
        with np.load(path) as found:
            errors = found["errors"]
            means = np.minimum(errors[~np.isnan(errors).any(axis=1)], 30.0).mean(axis=0)
            print(
                f"{odometry} {seed} {name:8} {len(errors):4} scans   "
                f"best {means.min():6.3f}  median {np.median(means):6.3f} %",
                flush=True,
            )
    return paths


def labelled(paths: list[Path]) -> tuple[list[LabelledSequence], NDArray[np.float64]]:
    """What was recorded, and the parameter sets in the unit cube."""
    sequences = []
    for path in paths:
        with np.load(path) as found:
            known = ~np.isnan(found["errors"]).any(axis=1)
            stamps, T_world_sensor = found["stamps"], found["T_world_sensor"]
            period = (stamps - stamps[0]) // 10**9
            histograms = found["histograms"].astype(np.float32)
            described = averaged(histograms, stamps, WINDOW, 1.0)
            few = found["motions"]
            motions = np.tile(np.eye(4), (*few.shape[:2], 1, 1))
            motions[..., :3, :] = few
            settings = TrialSettings()
            drive = Drive(
                stamps,
                T_world_sensor,
                described,
                period,
                settings.sub_trajectory,
                settings.lost_track,
                partial(np.take, motions, axis=1),
            )
            sequences.append(
                LabelledSequence(
                    path.stem.rsplit("-", 1)[1],
                    period[known],
                    described[known],
                    found["errors"][known],
                    vectors=found["vectors"][known],
                    drive=drive,
                )
            )
            sets = found["sets"]
    return sequences, sets


def validate(paths: list[Path], size: int) -> None:
    """Leave each sequence out in turn, and print what came of it."""
    sequences, sets = labelled(paths)
    left_out = leave_one_out(sequences, sets, bank=size).left_out
    for i, (of, sequence) in enumerate(zip(left_out, sequences, strict=True)):
        others = sequences[:i] + sequences[i + 1 :]
        data, _ = training_data(others, sets)
        of.errors.update(constantly(sequence, choose_bank(others, data.fixed, size)))
    validation = Validation(left_out)
    print_summary(validation, validation.ratios)
    for mode in validation.modes:
        each = zip(left_out, validation.ratios[mode], strict=True)
        print(f"{mode}: " + ", ".join(f"{of.name} {ratio:.2f}" for of, ratio in each))
    known = " ".join(f"{ratio:.3f}" for ratio in validation.portfolio())
    print(f"if the best of 1, 2, ... complementary sets were known: {known}", flush=True)


Errors = dict[str, NDArray[np.float64]]
"""Of a sequence in several modes, capped, at each frame that has a sub-trajectory."""


def constantly(sequence: LabelledSequence, members: Sequence[int]) -> Errors:
    """Errors of a bank whose weights are the same all the way."""
    assert sequence.vectors is not None
    vectors, lost = fusion.limited(sequence.vectors[:, members], 0)
    squares = np.einsum("ijx,ikx->jk", vectors, vectors) + np.diag((lost**2).sum(axis=0))
    return {
        "bank, even weights": bank_errors(
            sequence, members, np.full(len(members), 1.0 / len(members))
        ),
        # Nobody knows them who has not been there.
        "bank, best weights": bank_errors(sequence, members, fusion.least(squares)),
    }


def bank_errors(
    sequence: LabelledSequence, members: Sequence[int], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Errors of a bank with weights of shape (n_members,) or (n_periods, n_members)."""
    assert sequence.drive is not None
    n_periods = len(periods(sequence.drive.period)[0])
    of_periods = np.broadcast_to(weights, (n_periods, len(members)))
    errors = sequence.drive.errors(members, of_periods)
    return errors[~np.isnan(errors)]


def describe(folder: Path, courses: dict[str, Course], seed: int) -> list[Path]:
    """Describe a scan each second by every descriptor, and tell where it is kept."""
    paths = []
    for name, course in courses.items():
        path = folder / f"descriptors-{seed}-{course.length:.0f}-{name}.npz"
        paths.append(path)
        if path.exists():
            with np.load(path) as found:
                if set(DESCRIPTORS) <= set(found.files):
                    continue
        scans = list(simulate(course))[::PERIOD]
        of = {d: np.array([descriptor(d)(s) for s in scans], np.float32) for d in DESCRIPTORS}
        stamps, poses = zip(*((scan.stamp, scan.T_world_sensor) for scan in scans), strict=True)
        of[MOTION] = speed_and_turn_rate(np.array(stamps), np.array(poses)).astype(np.float32)
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(file, **of)  # type: ignore[arg-type]
        print(f"{name} is described", flush=True)
    return paths


def by_descriptor(paths: list[Path], described: list[Path], size: int) -> None:
    """Leave each sequence out in turn, scans being described in one way after the other.

    As if a scan looked in between as it did at the last full second, in every way the same; its
    motion is known at once.
    """
    of_ndt, sets = labelled(paths)
    pairs = (("ndt", name) for name in DESCRIPTORS if name != "ndt")
    for names in (*((name,) for name in DESCRIPTORS), *pairs):
        sequences = []
        for sequence, path, file in zip(of_ndt, paths, described, strict=True):
            with np.load(path) as found, np.load(file) as its:
                known = ~np.isnan(found["errors"]).any(axis=1)
                stamps = found["stamps"]
                blocks = [its[name][np.arange(len(stamps)) // PERIOD] for name in names]
            of_frames = averaged(np.hstack(blocks), stamps, WINDOW, 1.0)
            lengths = tuple(block.shape[1] for block in blocks)
            assert sequence.drive is not None
            drive = replace(sequence.drive, descriptors=of_frames)
            of_known = {"descriptors": of_frames[known], "blocks": lengths}
            sequences.append(replace(sequence, drive=drive, **of_known))
        print(f"by {' and '.join(names)}: ", end="")
        print_summary(leave_one_out(sequences, sets, {}, bank=size), ["bank"])


Take = Callable[[TrainingData], TrainingData]


class OfLess(Rule):
    """A rule that is fitted on less than there is."""

    def __init__(self, rule: Rule, less: Take):
        self.rule, self.less = rule, less

    def fit(self, data: TrainingData) -> Self:
        """See `Rule.fit`."""
        self.rule.fit(self.less(data))
        return self

    def predict(self, feature: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `Rule.predict`."""
        return self.rule.predict(feature)

    def select(self, feature: NDArray[np.float64], current: int | None = None) -> Selection:
        """See `Rule.select`."""
        return self.rule.select(feature, current)


def thinned(data: TrainingData, every: int) -> TrainingData:
    """Keep some of the frames."""
    kept = slice(None, None, every)
    return replace(
        data,
        features=data.features[kept],
        sequence=data.sequence[kept],
        errors=data.errors[kept],
    )


def with_gaps(data: TrainingData, share: float) -> TrainingData:
    """Keep a share of the pairs of a sequence and a set, the fixed set everywhere.

    And let the same sets be chosen as without gaps, which is not done otherwise.
    """
    errors, rng = data.errors.copy(), np.random.default_rng(0)
    for s in np.unique(data.sequence):
        never = rng.random(len(data.sets)) >= share
        never[data.fixed] = False
        errors[np.ix_(data.sequence == s, never)] = np.nan
    candidates = complementary(data.errors, data.sequence, data.fixed, 3)
    return replace(data, errors=errors, candidates=candidates)


def less(paths: list[Path]) -> None:
    """Leave each sequence out in turn, with less known of the others."""

    def maker(name: str, take: Take, every: int = 1) -> Maker:
        def make(others: Sequence[LabelledSequence], sets: Any) -> Rule:
            settings = tune(others, sets) if name == "paired" else Settings()
            of_less = {"n_frames": max(1, settings.n_frames // every)}
            return OfLess(RULES[name](settings.model_copy(update=of_less), 0.0), take)

        return make

    makers: dict[str, Maker] = {}
    for name in RULES:
        for every in (1, 2, 4, 10):
            kept = partial(thinned, every=every)
            makers[f"{name}, one frame in {every}"] = maker(name, kept, every)
        for share in (0.75, 0.5, 0.25):
            kept = partial(with_gaps, share=share)
            makers[f"{name}, {share:.0%} of the pairs"] = maker(name, kept)
    print_summary(leave_one_out(*labelled(paths), makers, bank=0), makers)


class Unafraid(PairedExpectedRatio):
    """One that takes any place for familiar."""

    def _familiarity(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.ones(len(squared))


class UnafraidFusion(Unafraid, PairedFusion):
    """The same, of a bank."""


class Between(PairedExpectedRatio):
    """One that knows each set, but for the fixed one, by its neighbours alone.

    As if it were to be chosen between those that were tried.
    """

    def _evidence(self) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
        fixed, mixed = super()._evidence()
        sets, errors = self.data_.sets, cap(self.data_.errors)
        squared = ((sets[:, None] - sets[self.candidates_]) ** 2).sum(axis=2)
        # Nobody is as near as the set itself would be.
        kernel = np.exp(-0.5 * (squared - _nearest_other(squared)) / self.settings.width**2)
        kernel[squared == 0.0] = 0.0
        alone = (errors @ (kernel / kernel.sum(axis=0))).astype(np.float32)
        at = self.candidates_ == self.data_.fixed
        return fixed, np.where(at, mixed, alone)


def _nearest_other(squared: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.where(squared > 0.0, squared, np.inf).min(axis=0))


def ablate(paths: list[Path], size: int) -> None:
    """Leave each sequence out in turn, and from the rules one ingredient after the other."""
    sequences, sets = labelled(paths)
    tuned: dict[str, Settings] = {}

    def maker(make: type[Rule], **changed: Any) -> Maker:
        def with_its_settings(others: Sequence[LabelledSequence], sets: Any) -> Rule:
            names = " ".join(other.name for other in others)
            if names not in tuned:
                tuned[names] = tune(others, sets)
            # A rule that is to take the fixed set always goes on to.
            given = {} if tuned[names].n_sets == 1 and "sharpness" not in changed else changed
            return make(tuned[names].model_copy(update=given), 0.0)  # type: ignore[call-arg]

        return with_its_settings

    paired = PairedExpectedRatio
    undoubting = {"n_sets": None, "sharpness": 12.0, "caution": 0.0, "threshold": 0.0}
    validation = leave_one_out(
        sequences,
        sets,
        {
            "paired": maker(paired),
            "without caution": maker(paired, caution=0.0),
            "two standard errors": maker(paired, caution=2.0),
            "without smoothing": maker(paired, width=1e-3),
            "two sets": maker(paired, n_sets=2),
            "all sets": maker(paired, n_sets=None),
            "the 30 nearest frames": maker(paired, n_frames=30),
            "without threshold": maker(paired, threshold=0.0),
            "familiar everywhere": maker(Unafraid),
            "sharpness 12": maker(paired, n_sets=3, sharpness=12.0),
            "sharpness 48": maker(paired, n_sets=3, sharpness=48.0),
            "all sets, without doubt": maker(paired, **undoubting),
            "by their neighbours alone": maker(Between, **undoubting),
        },
        bank=0,
    )
    left_out = validation.left_out
    for i, (of, sequence) in enumerate(zip(left_out, sequences, strict=True)):
        of.errors.update(banks(sequence, sequences[:i] + sequences[i + 1 :], sets, size))
    validation = Validation(left_out)
    print_summary(validation, [mode for mode in validation.ratios if mode != "baseline"])


def banks(
    sequence: LabelledSequence,
    others: list[LabelledSequence],
    sets: NDArray[np.float64],
    size: int,
) -> Errors:
    """Errors of a bank on the sequence left out, and without one ingredient after the other."""
    data, pca = training_data(others, sets)
    members = choose_bank(others, data.fixed, size)
    settings = tune_bank(others, sets, members, data.fixed)
    vectors = np.concatenate([s.vectors[:, members] for s in others if s.vectors is not None])
    data = replace(data, candidates=members, vectors=vectors)
    assert sequence.drive is not None
    first, _ = periods(sequence.drive.period)
    features = pca.transform(sequence.drive.descriptors[first])

    def driven(
        make: type[PairedFusion] = PairedFusion,
        ridge: float = fusion.RIDGE,
        last: int = fusion.STEADY,
        **changed: Any,
    ) -> NDArray[np.float64]:
        # A bank that is not worth driving is not driven.
        if settings.hedge == 1.0:
            return cap(sequence.errors[:, data.fixed])
        with patch.multiple(fusion, RIDGE=ridge, STEADY=last):
            rule = make(settings.model_copy(update=changed)).fit(data)
            near = rule.near(features)
            weights = fusion.steady(rule.weigh(near)[0], near.familiarity)
        return bank_errors(sequence, members, weights)

    found = {
        "bank": driven(),
        "bank, sequences weigh the same": driven(sharpness=0.0),
        "bank, sharpness 12": driven(sharpness=12.0),
        "bank, sharpness 48": driven(sharpness=48.0),
        "bank, nothing kept": driven(hedge=0.0),
        "bank, half kept": driven(hedge=0.5),
        "bank, familiar everywhere": driven(make=UnafraidFusion),
        "bank, the 100 nearest frames": driven(n_frames=100),
        "bank, limit 6": driven(limit=6.0),
        "bank, limit 18": driven(limit=18.0),
        "bank, errors count in full": driven(limit=1e9),
        "bank, likes do not share": driven(ridge=0.0),
        "bank, weights of each second": driven(last=1),
        "bank, weights of 20 seconds": driven(last=20),
    }
    return found | constantly(sequence, members)


def curve(paths: list[Path]) -> None:
    """Print what fewer training sequences would gain."""
    for row in learning_curve(*labelled(paths)):
        print(" ".join(f"{key} {value:.3g}" for key, value in row.items()), flush=True)


def print_summary(validation: Validation, modes: Iterable[str]) -> None:
    """Print the ratios to the fixed set's error."""
    print("geometric, arithmetic, worst ratio to the fixed set's error, sequences above 1.05")
    for mode in modes:
        s = validation.summary(mode)
        print(
            f"{mode:30}{s['geometric']:8.3f}{s['arithmetic']:8.3f}{s['worst']:8.2f}"
            f"{(validation.ratios[mode] > NO_WORSE).sum():4d}"
            f"   (95 % {s['low']:.2f}-{s['high']:.2f})",
            flush=True,
        )


def main() -> None:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", nargs="+", type=int, default=[10, 11])
    parser.add_argument("--length", type=float, default=120.0, help="metres of a course")
    parser.add_argument("--odometries", nargs="+", default=ODOMETRIES, choices=ODOMETRIES)
    parser.add_argument("--bank", type=int, default=BANK_SIZE, help="members of the bank")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--ablate", action="store_true", help="without one thing after the other")
    what.add_argument("--curve", action="store_true", help="with fewer training sequences")
    what.add_argument("--less", action="store_true", help="with fewer frames, or runs")
    what.add_argument("--descriptors", action="store_true", help="with other descriptors")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    # Open3D's NDT differs in its last bits from run to run on more than one core.
    os.sched_setaffinity(0, {int(os.environ.get("CORE", max(os.sched_getaffinity(0))))})
    for seed, odometry in itertools.product(arguments.seeds, arguments.odometries):
        courses = training_courses(seed, arguments.length)
        paths = trials(arguments.folder, odometry, courses, seed)
        if arguments.descriptors:
            by_descriptor(paths, describe(arguments.folder, courses, seed), arguments.bank)
        elif arguments.less:
            less(paths)
        elif arguments.curve:
            curve(paths)
        elif arguments.ablate:
            ablate(paths, arguments.bank)
        else:
            validate(paths, arguments.bank)


if __name__ == "__main__":
    main()
