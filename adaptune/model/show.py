"""Descriptions of error models, for people."""

from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType

from adaptune import report
from adaptune.metrics import cap
from adaptune.model.base import mean_errors
from adaptune.model.error_model import ErrorModel
from adaptune.space import Value, describe

N_BEST = 5
"""Sets to show, besides the fixed one."""


def render(model: ErrorModel, path: Path) -> RenderableType:
    """Describe a model: its odometry, its training, and what validation found.

    Parameters
    ----------
    model
        The model.
    path
        Its file.
    """
    n_frames, n_sets = model.errors.shape
    blocks = ", ".join(f"{name} ({n} numbers)" for name, n in model.blocks.items())
    window = f", mean of {model.window} selections" if model.window > 1 else ""
    size = path.stat().st_size / 1e6
    lines = [
        f"Error model of {model.odometry.get('name', 'an odometry')}: {n_sets} parameter sets on "
        f"{n_frames} frames of {len(model.sequences)} sequences, {size:.1f} MB",
        f"Errors over {model.length:g} m. Scans are described by {blocks}{window}.",
        *_pairs("Settings", model.odometry.get("settings", {})),
    ]
    return Group(
        "\n".join(lines),
        report.table("Sequences", _sequences(model), "Mean capped errors; a lost track is 30 %."),
        report.table("Parameters", _parameters(model)),
        report.table(f"The best sets of {n_sets}", _sets(model), "Mean error over all sequences."),
        "\n".join(_bank(model) + _pairs("From", model.provenance) + _validation(model)),
    )


def _bank(model: ErrorModel) -> list[str]:
    if not model.bank:
        return []
    sets = ", ".join(map(str, model.bank))
    if not model.bank_adapts:
        return [f"Bank: trials {sets}; it was not shown to pay, and is not used."]
    share = model.bank_settings.min_fixed_share
    return [f"Bank: trials {sets}; the first has {100 * share:.0f} % of the weight at least."]


def _pairs(title: str, data: Any) -> list[str]:
    if not isinstance(data, dict) or not data:
        return []
    return [f"{title}: " + ", ".join(f"{key} {value}" for key, value in data.items())]


def _validation(model: ErrorModel) -> list[str]:
    if not model.validation:
        return ["Not validated yet: `adaptune validate` shows whether adapting pays."]
    lines = []
    for rule, found in model.validation.items():
        pairs = found.items() if isinstance(found, dict) else ()
        short = {k: f"{v:.3g}" if isinstance(v, float) else v for k, v in pairs}
        lines += _pairs(f"Validation, {rule}", short) or [f"Validation, {rule}: {found}"]
    return lines


def _sequences(model: ErrorModel) -> list[dict[str, Any]]:
    rows = []
    fixed = model.sets.column(model.fixed)
    for s, name in enumerate(model.sequences):
        errors = model.errors[model.sequence == s]
        run = ~np.isnan(errors).all(axis=0) if len(errors) else np.zeros(len(model.sets), bool)
        row: dict[str, Any] = {"sequence": name, "frames": len(errors), "sets": int(run.sum())}
        row |= {"fixed [%]": None, "best [%]": None, "best set": None, "lost, fixed [%]": None}
        if run.any():
            means = np.full(len(run), np.inf)
            means[run] = np.nanmean(cap(errors[:, run]), axis=0)
            best = int(np.argmin(means))
            row |= {"best [%]": float(means[best]), "best set": model.sets.trials[best]}
        if run.any() and run[fixed]:
            row["fixed [%]"] = float(means[fixed])
            row["lost, fixed [%]"] = float(100.0 * np.isinf(errors[:, fixed]).mean())
        rows.append(row)
    return rows


def _parameters(model: ErrorModel) -> list[dict[str, Any]]:
    fixed = model.sets[model.fixed]
    return [
        {
            "parameter": name,
            "range": describe(parameter) + (" log" if getattr(parameter, "log", False) else ""),
            "baseline": _short(parameter.baseline),
            "fixed": _short(fixed[name]),
        }
        for name, parameter in model.sets.space.parameters.items()
    ]


def _sets(model: ErrorModel) -> list[dict[str, Any]]:
    means = mean_errors(model.errors, model.sequence)
    best = [model.sets.trials[c] for c in np.argsort(means, kind="stable")[:N_BEST]]
    if model.fixed not in best:
        best.insert(0, model.fixed)
    return [
        {"set": f"{n}, fixed" if n == model.fixed else str(n)}
        | {"mean [%]": float(means[model.sets.column(n)])}
        | {name: _short(value) for name, value in model.sets[n].items()}
        for n in best
    ]


def _short(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
