"""Descriptions of error models, for people."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from adaptune import report
from adaptune.metrics import cap
from adaptune.model.base import mean_errors
from adaptune.model.error_model import ErrorModel
from adaptune.parameter_sets import in_words
from adaptune.pooled_space import ODOMETRY
from adaptune.space import Categorical, Parameter, ParameterSet, describe, label

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
    window = f", as a mean over {model.window} selections in a row" if model.window > 1 else ""
    size, n = path.stat().st_size / 1e3, len(model.sequences)
    return Group(
        Text(
            f"Error model of {model.odometry.get('name', 'an odometry')}: {n_sets} parameter sets "
            f"on {n_frames} frames of {n} sequence{'s' if n > 1 else ''}, {size:,.0f} kB\n"
            f"Errors over {model.length:g} m. Scans are described by {blocks}{window}."
        ),
        *_named("Settings", model.odometry.get("settings", {})),
        report.table("Sequences", _sequences(model), "Mean capped errors; a lost track is 30 %."),
        report.table("Parameters", _parameters(model)),
        report.table(f"The best sets of {n_sets}", _best(model), "Mean error over all sequences."),
        *_adapting(model),
        *_spending(model),
        *_named("Where it comes from", model.provenance),
        *_validation(model),
    )


def _adapting(model: ErrorModel) -> Iterator[RenderableType]:
    """What is selected along the way."""
    paired, bank = model.paired, model.bank_settings
    if not paired.adapt:
        yield Text("One set at a time: no less expected loss; `paired` does not use it.")
    else:
        n = "all" if paired.n_sets is None else str(paired.n_sets)
        yield Text(f"One set at a time: `paired` chooses among {n} sets.")
    if not model.bank:
        return
    if not bank.adapt:
        yield Text("Bank: it has not the least expected loss.")
        if not model.bank_rests:
            return
    else:
        share = 100 * bank.min_fixed_share
        yield Text(f"Bank: the first member has {share:.0f} % of the weight at least.")
    if model.reserve:
        reserve = ", ".join(map(str, model.reserve))
        yield Text(f"Members that work only in new places and after failures: {reserve}.")
    yield report.table(f"The bank's {len(model.bank)} members", _sets(model, model.bank))


def _spending(model: ErrorModel) -> Iterator[RenderableType]:
    """What a bank costs, what may be spent, and what could be driven instead."""
    costs = model.costs
    if costs is not None and model.bank and np.isfinite(cost := costs.adaptive(model.bank)):
        yield Text(
            f"All members of the bank together cost {cost:.1f} ms of CPU time a scan, "
            f"{costs.evidence:.1f} ms of it for live evidence."
        )
    if model.budget is not None:
        yield Text(f"Budget: {model.budget:g} ms of CPU time a scan.")
    if model.rivals:
        rows = [
            {"rival": name} | row
            for name, trial in model.rivals.items()
            for row in _sets(model, [trial])
        ]
        yield report.table("Rivals", rows, "What could be driven without adapting.")


def _named(title: str, data: Mapping[str, Any]) -> list[Table]:
    """A table of plain data, if there are any."""
    rows = [{"key": key, "value": value} for key, value in _flat(data)]
    return [report.table(title, rows)] if rows else []


def _flat(data: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Dotted keys and values in words."""
    for key, value in data.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{above}{key}.")
        elif value is not None and value != []:
            yield f"{above}{key}", _words(value)


def _words(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {text}" for key, text in _flat(value))
    if isinstance(value, list | tuple):
        nested = any(isinstance(item, Mapping | list | tuple) for item in value)
        return ("; " if nested else ", ").join(map(_words, value))
    if isinstance(value, bool):
        return str(value).lower()  # as in YAML
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _validation(model: ErrorModel) -> list[RenderableType]:
    """Numbers in a table, and the rest in words."""
    if not model.validation:
        return [Text("Not validated yet: `adaptune validate` shows what adapting gains.")]
    found = {
        rule: of_rule if isinstance(of_rule, Mapping) else {"found": of_rule}
        for rule, of_rule in model.validation.items()
    }
    keys = dict.fromkeys(key for of_rule in found.values() for key in of_rule)
    numbers = [k for k in keys if all(isinstance(f.get(k, 0.0), float) for f in found.values())]
    rows = [
        {"rule": rule} | {k: of_rule.get(k) for k in numbers} for rule, of_rule in found.items()
    ]
    caption = "Ratios to the fixed set's error on what is left out; low, high: 95 % interval."
    made: list[RenderableType] = [report.table("Validation", rows, caption)] if numbers else []
    for rule, of_rule in found.items():
        rest = {key: value for key, value in of_rule.items() if key not in numbers}
        made += [Text(f"{rule}, {key}: {text}") for key, text in _flat(rest)]
    return made


def _sequences(model: ErrorModel) -> list[dict[str, Any]]:
    rows = []
    fixed = model.sets.column(model.fixed)
    for s, name in enumerate(model.sequences):
        errors = model.errors[model.sequence == s]
        run = ~np.isnan(errors).all(axis=0) if len(errors) else np.zeros(len(model.sets), bool)
        row: dict[str, Any] = {"sequence": name, "frames": len(errors), "sets": int(run.sum())}
        row |= {"fixed [%]": None, "best [%]": None, "best set": None, "lost frames, fixed": None}
        if run.any():
            means = np.full(len(run), np.inf)
            means[run] = np.nanmean(cap(errors[:, run]), axis=0)
            best = int(np.argmin(means))
            row |= {"best [%]": float(means[best]), "best set": model.sets.trials[best]}
        if run.any() and run[fixed]:
            row["fixed [%]"] = float(means[fixed])
            row["lost frames, fixed"] = int(np.isinf(errors[:, fixed]).sum())
        rows.append(row)
    return rows


def _parameters(model: ErrorModel) -> list[dict[str, Any]]:
    fixed = model.sets.space.flat(model.sets[model.fixed])
    return [
        {
            "parameter": label(name, parameter),
            "range": _range(parameter),
            "baseline": _words(parameter.baseline),
            "fixed": _words(fixed.get(name, "-")),
        }
        for name, parameter in model.sets.space.parameters.items()
    ]


def _range(parameter: Parameter) -> str:
    if isinstance(parameter, Categorical):
        return _words(parameter.choices)
    return describe(parameter) + (" log" if parameter.log else "")


def _best(model: ErrorModel) -> list[dict[str, Any]]:
    means = mean_errors(model.errors, model.sequence)
    best = [model.sets.trials[c] for c in np.argsort(means, kind="stable")[:N_BEST]]
    return _sets(model, best if model.fixed in best else [model.fixed, *best])


def _sets(model: ErrorModel, trials: Sequence[int]) -> list[dict[str, Any]]:
    means = mean_errors(model.errors, model.sequence)
    return [
        {"set": f"{n}, fixed" if n == model.fixed else str(n)}
        | {"mean [%]": float(means[model.sets.column(n)])}
        | ({} if model.costs is None else {"cost [ms]": model.costs.alone(n)})
        | _values(model.sets[n])
        for n in trials
    ]


def _values(parameters: ParameterSet) -> dict[str, str]:
    """Columns of a set; those of several odometries have too many for a column each."""
    if ODOMETRY not in parameters:
        return {name: _words(value) for name, value in parameters.items()}
    own = {name: value for name, value in parameters.items() if name != ODOMETRY}
    return {ODOMETRY: str(parameters[ODOMETRY]), "parameters": in_words(own)}
