"""What a selection costs, and a model's file, at the size of KITTI's training sequences.

    python benchmarks/selection.py [PICTURE.png]

Random numbers take the places of scans and errors: 14,136 frames in six sequences, 10 components
of the descriptor and 2 parameters; 256 sets a sequence (3.6 million pairs), and the same 1536 sets
for all (21.7 million). One thread on one core. Limits: `paper` 10 ms in the median and 20 ms
for 99 %, `adaptive` 5 ms in the median; 100 times faster than 256 iterations of TPE on
scikit-learn's KNeighborsRegressor over the same 3.6 million rows, and 5 times faster than one call
of it on the same candidates; file 100 MB, load 1 s, fit 10 s. Where other programs share the core,
CPU time says more than the time by the clock.

With a PICTURE, the script draws the cost of a selection against 1,000 to 1,000,000 frames of 64
sets.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from numpy.typing import NDArray
from sklearn.neighbors import KNeighborsRegressor
from threadpoolctl import threadpool_limits

from adaptune._system import machine
from adaptune.model import (
    BankRule,
    ErrorModel,
    FixedSet,
    Rule,
    TrainingData,
)
from adaptune.model.knn import NearestNeighbours
from adaptune.report.charts import Axis, Chart, Line, Panel
from adaptune.report.drawing import draw_chart
from adaptune.space import Float, ParameterSets, ParameterSpace
from offline.validate import BANK_SIZE

LENGTHS = (4541, 1101, 4661, 801, 271, 2761)
"""Scans of KITTI's sequences 00 to 05."""
SPACE = ParameterSpace(
    {
        "max_correspondence_distance": Float(low=1.0, high=10.0, baseline=4.0),
        "keyframe_interval": Float(low=1.0, high=30.0, baseline=4.0),
    }
)
PER_SEQUENCE = 256
N_COMPONENTS = 10


def numbered(unit: NDArray[np.float64]) -> ParameterSets:
    """Parameter sets from points of the unit cube; their rows are the trial numbers."""
    return ParameterSets(SPACE, tuple(range(len(unit))), tuple(SPACE.from_unit(unit)))


def kitti_size(seed: int, own_sets: bool) -> ErrorModel:
    """A model of places that change along the way, and errors that depend on the place."""
    rng = np.random.default_rng(seed)
    places = [np.cumsum(rng.normal(0.0, 0.03, (n, N_COMPONENTS)), axis=0) for n in LENGTHS]
    place = np.concatenate([p + rng.normal(size=N_COMPONENTS) for p in places])
    mixing = rng.normal(0.0, 0.5, (N_COMPONENTS, 90))
    counts = rng.poisson(5.0 * np.exp(np.clip(place @ mixing, -4.0, 4.0)))
    unit = rng.random((PER_SEQUENCE * len(LENGTHS), len(SPACE)))
    sequence = np.repeat(np.arange(len(LENGTHS)), LENGTHS)
    best = 0.5 + 0.2 * np.tanh(place[:, : len(SPACE)]).astype(np.float32)
    errors = rng.gamma(4.0, 0.1, (len(place), len(unit))).astype(np.float32)
    for p in range(len(SPACE)):
        errors += (best[:, p, None] - unit[:, p].astype(np.float32)) ** 2
    errors[rng.random(errors.shape, np.float32) < 0.02] = np.inf
    if own_sets:
        errors[sequence[:, None] != np.arange(len(unit)) // PER_SEQUENCE] = np.nan
    n_bank = 0 if own_sets else BANK_SIZE
    return ErrorModel(
        odometry={"name": "gicp", "settings": {}},
        sets=numbered(unit),
        fixed=0,
        length=100.0,
        sequences=[f"{s:02d}" for s in range(len(LENGTHS))],
        blocks={"ndt": 90},
        window=1,
        descriptors=np.minimum(counts, 60_000).astype(np.float32),
        sequence=sequence,
        errors=errors,
        provenance={},
        bank=list(range(n_bank)),
        vectors=rng.normal(0.0, 0.3, (len(place) if n_bank else 0, n_bank, 3)).astype(np.float32),
    )


def seconds(function: Callable[[], object]) -> float:
    """Time one call."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def costs(function: Callable[[Any], object], arguments: Iterable[Any]) -> NDArray[np.float64]:
    """Milliseconds by the clock and on the core, of shape (2, n)."""
    found = []
    for argument in arguments:
        cpu, clock = time.thread_time(), time.perf_counter()
        function(argument)
        found.append((time.perf_counter() - clock, time.thread_time() - cpu))
    return 1e3 * np.array(found).T


def measure_file(model: ErrorModel, folder: Path) -> ErrorModel:
    """Save and load."""
    path = folder / "model.safetensors"
    saving = seconds(lambda: model.save(path))
    clock, cpu = np.median(costs(ErrorModel.load, [path] * 5), axis=1)
    print(
        f"file {path.stat().st_size / 1e6:.1f} MB (limit 100), saved in {saving:.2f} s, "
        f"loaded and checked in {1e-3 * clock:.2f} s, CPU {1e-3 * cpu:.2f} s (limit 1)"
    )
    return ErrorModel.load(path)


def measure_selection(
    model: ErrorModel, name: str, rule: Rule, limits: str, members: list[int] | None = None
) -> tuple[Rule, float, NDArray[np.float32]]:
    """Fit, then select from descriptors that no training frame has."""
    begin = time.perf_counter()
    pca = model.pca()
    rule.fit(model.training_data(pca, members))
    fitting = time.perf_counter() - begin
    rng = np.random.default_rng(1)
    scans = rng.poisson(model.descriptors[rng.integers(0, len(model.descriptors), 1000)])
    asked = scans.astype(np.float32)
    select: Callable[[Any], object] = lambda x: rule.select(pca.transform(x[None])[0])  # noqa: E731
    costs(select, asked[:20])
    clock, cpu = costs(select, asked)
    print(
        f"{name:8} fit {fitting:5.2f} s (limit 10), selection: median {np.median(clock):.3f} ms, "
        f"99 % {np.percentile(clock, 99):.3f} ms; CPU median {np.median(cpu):.3f} ms, "
        f"99 % {np.percentile(cpu, 99):.3f} ms ({limits})"
    )
    return rule, float(np.median(clock)), asked


def against_rows(model: ErrorModel) -> None:
    """Compare with the published way: a regressor over all rows, for TPE or all candidates."""
    rule, ours, asked = measure_selection(
        model, "paper", NearestNeighbours(), "limits: median 10, 99 % 20"
    )
    assert isinstance(rule, NearestNeighbours)
    data = rule.data_
    unit = data.sets.unit
    scale = float(unit.std(axis=0).mean())
    frame, which = np.nonzero(~np.isnan(data.errors))
    rows = np.hstack([data.features[frame], unit[which] / scale])
    rival = KNeighborsRegressor(5)
    fitting = seconds(lambda: rival.fit(rows, np.minimum(data.errors[frame, which], 30.0)))
    print(f"scikit-learn: {len(rows)} rows, fit {fitting:.2f} s")
    features = model.pca().transform(asked)
    candidates = []
    for feature in features[:5]:
        at = np.hstack([np.tile(feature, (len(unit), 1)), unit / scale])
        begin = time.perf_counter()
        predicted = rival.predict(at)
        candidates.append(time.perf_counter() - begin)
        np.testing.assert_allclose(rule.predict(feature), predicted, rtol=1e-5)
    searches = [tpe(rival, feature, scale) for feature in features[:3]]
    whole, asking = np.median(searches, axis=0)
    one = float(np.median(candidates))
    print(
        f"scikit-learn, the same {len(data.sets)} candidates in one call: {1e3 * one:.1f} ms, "
        f"{1e3 * one / ours:.0f} times ours (limit 5)"
    )
    print(
        f"scikit-learn, 256 iterations of TPE: {1e3 * whole:.0f} ms, of which {1e3 * asking:.0f} "
        f"ms in the regressor, {1e3 * whole / ours:.0f} times ours (limit 100)"
    )


def tpe(
    regressor: KNeighborsRegressor, feature: NDArray[np.float64], scale: float
) -> tuple[float, float]:
    """Seconds that a search by Optuna takes, and those of them that the regressor takes."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    asking = 0.0

    def objective(trial: optuna.Trial) -> float:
        nonlocal asking
        unit = [trial.suggest_float(name, 0.0, 1.0) for name in SPACE.names]
        begin = time.perf_counter()
        error = regressor.predict(np.concatenate([feature, np.array(unit) / scale])[None])[0]
        asking += time.perf_counter() - begin
        return float(error)

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=0))
    return seconds(lambda: study.optimize(objective, n_trials=256)), asking


def draw_growth(path: Path, n_sets: int = 64, n_sequences: int = 16) -> None:
    """Draw the cost of a selection against the number of training frames."""
    rng = np.random.default_rng(2)
    sizes = [1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000]
    medians: dict[str, list[float]] = {"paper": [], "adaptive": []}
    for n in sizes:
        data = TrainingData(
            np.cumsum(rng.normal(0.0, 0.05, (n, N_COMPONENTS)), axis=0),
            np.arange(n) * n_sequences // n,
            rng.gamma(1.0, 1.0, (n, n_sets)).astype(np.float32),
            numbered(rng.random((n_sets, len(SPACE)))),
            0,
        )
        asked = data.features[rng.integers(0, n, 100)] + 0.1
        for name, rule in (("paper", NearestNeighbours()), ("adaptive", FixedSet())):
            rule.fit(data)
            costs(rule.select, asked[:5])
            medians[name].append(float(np.median(costs(rule.select, asked)[1])))
        print(f"{n:8} frames: " + ", ".join(f"{k} {v[-1]:.3f} ms" for k, v in medians.items()))
    x = Axis(f"training frames [-], {n_sequences} sequences, {n_sets} sets", log=True)
    y = Axis("CPU time of a selection [ms]", log=True)
    lines = tuple(Line(sizes, of_rule, name) for name, of_rule in medians.items())
    chart = Chart("selection", "Cost of a selection", (Panel(x, y, lines),))
    draw_chart(chart, path, path.with_suffix(".svg"))


def main(png: Path | None) -> None:
    """Measure everything."""
    machine.pin(1)
    threadpool_limits(1)
    with tempfile.TemporaryDirectory() as folder:
        print(f"256 sets a sequence, {len(LENGTHS)} sequences")
        against_rows(measure_file(kitti_size(0, own_sets=True), Path(folder)))
        print("\n1536 sets, the same for all sequences")
        model = measure_file(kitti_size(0, own_sets=False), Path(folder))
        measure_selection(model, "paper", NearestNeighbours(), "limits: median 10, 99 % 20")
        measure_selection(model, "adaptive", FixedSet(), "limit: median 5")
        bank = BankRule()
        measure_selection(model, "bank", bank, "limit: median 5", model.bank)
    if png is not None:
        print("\nCPU time of a selection against training frames")
        draw_growth(png)


if __name__ == "__main__":
    if len(sys.argv) > 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]) if len(sys.argv) == 2 else None)
