"""Chart of descriptors: where the test sequences lie among what was trained on."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from adaptune.errors import AdaptuneError
from adaptune.files import DAMAGED_NPZ, replacing
from adaptune.model import ErrorModel
from adaptune.model.descriptor import MOTION, Describer
from adaptune.report.charts import Axis, Chart, Charts, Panel, Points, charts_of
from adaptune.study.study import Study

MOST_FRAMES = 300
"""Frames of a sequence that are drawn."""
MOST_NAMED = 16
"""Sequences that are told apart; others look alike."""
FOLDER = "described"
"""Folder of a study that keeps the descriptors of test sequences."""


def charts_of_descriptors(study: Study) -> Charts:
    """The chart of a model's descriptors and those of the test sequences, and what is missing.

    The first time, the scans of the test sequences are read, and one a second is described; what is
    found is kept in the study's folder.
    """
    if not study.model_path.exists():
        return Charts([], ["No model: run `adaptune offline`."])
    model = ErrorModel.load(study.model_path)
    name = described_by(model)
    if name is None:
        return Charts([], ["No descriptors of scans: the model knows the motion alone."])
    tests: dict[str, NDArray[np.float32]] = {}
    notes = []
    for sequence in study.config.test:
        try:
            tests[sequence] = descriptors_along(study, sequence, name)
        except (AdaptuneError, OSError) as error:
            notes.append(f"No descriptors of {sequence}: {error}.")
    return charts_of([descriptor_chart(model, name, tests), *notes])


def described_by(model: ErrorModel) -> str | None:
    """The first descriptor of a model that describes scans, and not the motion."""
    return next((name for name in model.blocks if name != MOTION), None)


def descriptors_along(study: Study, sequence: str, name: str) -> NDArray[np.float32]:
    """Descriptors of a sequence once a selection, averaged as a selector does.

    Parameters
    ----------
    study
        Its folder keeps them in ``described``.
    sequence
        Of a test.
    name
        Of the descriptor.

    Returns
    -------
    ndarray of shape (n_selections, n_features)

    Raises
    ------
    AdaptuneError
        If the recording is gone, or cannot be read.
    """
    period = study.config.online.period
    about = study.sequences.identity(sequence) | {"descriptor": name, "period": period}
    text = json.dumps(about, sort_keys=True)
    path = study.folder / FOLDER / f"{sequence}.npz"
    described = _kept(path, text)
    if described is None:
        described = _described(study, sequence, name)
        with replacing(path) as temporary, temporary.open("wb") as file:
            about_it = np.frombuffer(text.encode(), np.uint8)
            np.savez_compressed(file, about=about_it, descriptors=described)
    return moving_mean(described, study.window)


def moving_mean(descriptors: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """Mean of each row and of the `n` - 1 rows before it, or of as many as there are."""
    sums = np.concatenate([np.zeros((1, descriptors.shape[1])), np.cumsum(descriptors, axis=0)])
    stop = np.arange(1, len(descriptors) + 1)
    first = np.maximum(stop - n, 0)
    return np.asarray((sums[stop] - sums[first]) / (stop - first)[:, None], np.float32)


def _kept(path: Path, about: str) -> NDArray[np.float32] | None:
    """What is kept of the same recording; None if there is none."""
    try:
        with np.load(path, allow_pickle=False) as file:
            if file["about"].tobytes().decode() == about:
                return np.asarray(file["descriptors"], np.float32)
    except (FileNotFoundError, KeyError, *DAMAGED_NPZ):
        pass
    return None


def _described(study: Study, sequence: str, name: str) -> NDArray[np.float32]:
    from adaptune.selector import Schedule  # which imports compiled code

    describe, schedule = Describer([name]), Schedule(study.config.online.period * 1e9)
    scans = study.sequences.open(sequence)
    found = [describe(scan) for scan in scans if schedule.due(scan.stamp)]
    return np.array(found, np.float32)


def descriptor_chart(
    model: ErrorModel, name: str, tests: Mapping[str, NDArray[np.float32]]
) -> Chart | None:
    """The first two principal components of training frames and of test sequences.

    Parameters
    ----------
    model
        Holds the training frames.
    name
        Of the descriptor that is shown.
    tests
        By name of a test sequence its descriptors, of shape (n, n_features) each.
    """
    from adaptune.model.pca import ScaledPCA  # takes long to import

    names = list(model.blocks)
    begin = sum(model.blocks[other] for other in names[: names.index(name)])
    training = model.descriptors[:, begin : begin + model.blocks[name]].astype(np.float64)
    if len(training) < 2 or training.shape[1] < 2:
        return None
    # As the model's own, of which these are the first two of this descriptor.
    pca = ScaledPCA(2).fit(training)
    places, total = pca.transform(training), float(training.var(axis=0).sum())
    shares = 100.0 * (places * pca.scale_).var(axis=0) / max(total, 1e-12)
    of_training = {
        sequence: places[model.sequence == i] for i, sequence in enumerate(model.sequences)
    }
    of_tests = {
        n: pca.transform(of) for n, of in tests.items() if of.shape[1:] == (len(pca.mean_),)
    }
    axes = [
        Axis(f"component {i} ({share:.0f} % of the variance) [-]")
        for i, share in enumerate(shares, start=1)
    ]
    x, y = _thinned(places, MOST_NAMED * MOST_FRAMES)
    behind = Points(x, y, "all training", faint=True)
    panels = [Panel(axes[0], axes[1], _sequences(of_training), "training", height=1.5)]
    if of_tests:
        drawn = (behind, *_sequences(of_tests))
        panels.append(Panel(axes[0], axes[1], drawn, "test", height=1.5))
    return Chart(
        "descriptors",
        f"What the scans look like: the descriptor {name}",
        tuple(panels),
        "Each point is a scan, by the two directions in which training scans differ most. Test "
        "scans far from all training are of new surroundings, about which training says little.",
        columns=2,
    )


def _sequences(places: Mapping[str, NDArray[np.float64]]) -> tuple[Points, ...]:
    """Points of sequences, of shape (n, 2) each."""
    named = dict(list(places.items())[:MOST_NAMED])
    if others := [of for name, of in places.items() if name not in named]:
        named["others"] = np.concatenate(others)
    thinned = {name: _thinned(of, MOST_FRAMES) for name, of in named.items()}
    return tuple(Points(x, y, name) for name, (x, y) in thinned.items())


def _thinned(places: NDArray[np.float64], most: int) -> NDArray[np.float64]:
    """At most so many of them, of shape (2, m)."""
    some = np.unique(np.linspace(0, len(places) - 1, most).astype(int))
    return np.asarray(places[some].T)
