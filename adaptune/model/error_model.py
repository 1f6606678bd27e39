"""The error model: what passes from training to the robot."""

import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PositiveInt, create_model
from rich.console import Group, RenderableType
from rich.text import Text
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from adaptune import __version__
from adaptune._system.files import replacing
from adaptune._system.strict import in_one_line
from adaptune.errors import AdaptuneError
from adaptune.model.descriptor import DESCRIPTORS, compact
from adaptune.model.rules import Costs, TrainingData, allowed_sets, mean_errors
from adaptune.model.weights import BankSettings
from adaptune.recording.scan import segment_numbers
from adaptune.report import tables
from adaptune.space import ParameterSets, SpaceError, in_words, load_space

if TYPE_CHECKING:
    from adaptune.model.knn import ScaledPCA

FORMAT = 10
"""Raised whenever an older adaptune could not read the file, or would read it wrongly."""


class ModelError(AdaptuneError):
    """A model file that cannot be used."""


def digest(header: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> str:
    """Digest of a header and arrays, in hexadecimal."""
    found = hashlib.sha256(json.dumps(header).encode())
    for name in sorted(arrays):
        found.update(np.ascontiguousarray(arrays[name]).data)
    return found.hexdigest()[:16]


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a header and arrays, in about as much memory as the file is large.

    A damaged file leads to one of many errors, that of another format to a `ModelError`.
    """
    with path.open("rb"), safe_open(path, "np") as file:
        text = json.loads((file.metadata() or {})["adaptune"])
        found, version = int(text["format"]), str(text["version"])
        if found != FORMAT:
            raise ModelError(
                f"{path}: has format {found} (of adaptune {version}), which is "
                f"{'newer' if found > FORMAT else 'older'} than {FORMAT} (of this one, "
                f"{__version__}); run `adaptune offline` again, which fits the model to the "
                f"finished trials"
            )
        arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
    if digest(text["header"], arrays) != text["digest"]:
        raise ValueError("its content is not what was written")
    for name, known in _ARRAY_TYPES.items():
        if arrays[name].dtype.str not in known:
            raise ValueError(f"{name} holds {arrays[name].dtype}, not {' or '.join(known)}")
    # Only in JSON are the trials' numbers texts.
    return dict(_header_model().model_validate_json(json.dumps(text["header"]))), arrays


SAME_SENSOR = 3.0
"""Degrees by which the lowest points of one sensor's scans may differ between drives."""

_ARRAY_TYPES = {
    "descriptors": ("<u2", "<f4"),
    "sequence": ("<u4",),
    "segment": ("<u4",),
    "errors": ("<f4",),
    "vectors": ("<f4",),
}
"""The arrays in a file, and the types that they may have."""


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Everything that selection needs to know about a study."""

    odometry: dict[str, Any]  # its name and settings
    sets: ParameterSets  # by the numbers of their trials
    fixed: int  # trial number of the set that is best over all training sequences
    length: Annotated[float, Field(gt=0, allow_inf_nan=False)]  # metres of a sub-trajectory
    sequences: list[str]  # names of the training sequences
    blocks: dict[str, PositiveInt]  # by name, in order, the number of features of each descriptor
    # Number of descriptors that are averaged: a selection's and those of the selections before.
    window: PositiveInt
    descriptors: NDArray[np.float32]  # (n_frames, n_features): averaged
    sequence: NDArray[np.intp]  # (n_frames,): number of each frame's sequence
    # (n_frames, n_sets): percent, infinite where the track was lost, NaN where a set was not run.
    errors: NDArray[np.float32]
    provenance: dict[str, Any]  # where the model comes from, for people
    # (n_frames,): number of each frame's segment in its recording; by
    # default each recording is one segment.
    segment: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))
    bank: list[int] = field(default_factory=list)  # its members' trials, the fixed set's first
    bank_size: int = 0  # members that were asked for; costs may allow fewer
    # (n_frames, len(bank), 3): their errors as vectors, see `TrainingData`.
    vectors: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 0, 3), np.float32))
    # For each training sequence, degrees at which its scans' lowest points lie, see
    # `adaptune.model.descriptor.lowest_elevation`; empty if unknown.
    elevations: list[float] = field(default_factory=list)
    # Chosen on the training sequences.
    bank_settings: BankSettings = field(default_factory=BankSettings)
    # What was expected of a bank with these settings, see `offline.bank_choice.Figures`; empty
    # where too little is known to compare.
    expected: dict[str, float] = field(default_factory=dict)
    recommended: str = "fixed"  # the mode to drive
    budget: float | str | None = None  # the study's, see `OnlineConfig`
    milliseconds: float | None = None  # what that is of CPU time a scan
    costs: Costs | None = None  # what the sets cost; None if it was not measured

    def __post_init__(self) -> None:
        if not len(self.segment):
            object.__setattr__(self, "segment", np.zeros(len(self.sequence), np.intp))

    def __repr__(self) -> str:
        what = f"{len(self.sets)} sets on {len(self.errors)} frames of {', '.join(self.sequences)}"
        return f"<ErrorModel of {self.odometry['name']}: {what}; fixed: {self.fixed}>"

    @property
    def reserve(self) -> list[int]:
        """The members of the bank that rest where the training knows the place."""
        return self.bank[len(self.bank) - self.bank_settings.reserve :]

    def pca(self) -> "ScaledPCA":
        """Principal components of the training frames' descriptors."""
        from adaptune.model.knn import ScaledPCA  # not needed to load a model

        return ScaledPCA(self.blocks.values()).fit(self.descriptors)

    def segments(self) -> NDArray[np.intp]:
        """Number of every frame's segment among all of the model, of shape (n_frames,)."""
        return segment_numbers(self.sequence, self.segment)

    def training_data(self, pca: "ScaledPCA", members: Sequence[int] | None = None) -> TrainingData:
        """What selection rules are fitted to; `pca` is what `pca` returned.

        Some of the bank's `members` may be the only candidates; the first counts as the fixed one.
        There is a `ModelError` if the bank does not hold one of them.
        """
        data = TrainingData(
            pca.transform(self.descriptors),
            self.segments(),
            self.errors,
            self.sets,
            self.fixed,
            allowed=self.allowed(),
            costs=self.costs,
        )
        if members is None:
            return data
        if unknown := [trial for trial in members if trial not in self.bank]:
            raise ModelError(
                f"the model's bank does not hold trial {unknown[0]}, only {self.bank}; run "
                f"`adaptune offline` again"
            )
        vectors = self.vectors[:, [self.bank.index(trial) for trial in members]]
        return replace(data, fixed=members[0], candidates=tuple(members), vectors=vectors)

    def allowed(self) -> tuple[int, ...] | None:
        """See `allowed_sets`."""
        return allowed_sets(self.costs, self.milliseconds, self.sets, self.fixed)

    def check_descriptors(
        self, descriptors: Collection[str], where: Path | str = "the model"
    ) -> None:
        """Refuse, by a `ModelError`, a model that would run code which was not asked for.

        Those of `descriptors` may be used besides adaptune's own.
        """
        for name in self.blocks:
            if name not in DESCRIPTORS and name not in descriptors:
                raise ModelError(
                    f"{where}: uses the descriptor {name!r}, which adaptune does not have; if it "
                    f"is code that you trust, name it in `descriptor`, too, or fit a model of your "
                    f"own (`adaptune offline`)"
                )

    def is_foreign(self, elevation: float) -> bool:
        """Whether a scan with that `lowest_elevation` comes from no sensor of the training's."""
        differences = [abs(elevation - known) for known in self.elevations]
        return bool(differences) and min(differences) > SAME_SENSOR

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {
            "descriptors": np.ascontiguousarray(compact(self.descriptors)),
            "sequence": self.sequence.astype(np.uint32),
            "segment": self.segment.astype(np.uint32),
            "errors": np.ascontiguousarray(self.errors, np.float32),
            "vectors": np.ascontiguousarray(self.vectors, np.float32),
        }

    def _header(self) -> dict[str, Any]:
        """All that selections depend on, besides the arrays."""
        plain = (
            *("odometry", "fixed", "length", "sequences", "blocks", "window", "elevations"),
            *("bank", "bank_size", "budget", "milliseconds", "recommended"),
        )
        return {
            "space": self.sets.space.definition(),
            "trials": self.sets.trials,
            "sets": self.sets.parameters,
            "bank_settings": self.bank_settings.model_dump(),
        } | {name: getattr(self, name) for name in plain}

    @property
    def digest(self) -> str:
        """Digest of everything that selections depend on."""
        return digest(self._header(), self._arrays())

    def save(self, path: Path | str) -> None:
        """Write the model to one file, in the safetensors format. Numbers keep all their bits."""
        header, arrays = self._header(), self._arrays()
        header |= {"provenance": self.provenance, "expected": self.expected}
        header["costs"] = None if self.costs is None else asdict(self.costs)
        # Through JSON, so that the digest is of what is read.
        header = json.loads(json.dumps(header))
        text = {"format": FORMAT, "version": __version__, "digest": digest(header, arrays)}
        # The format keeps no order of several entries, and the same model shall have the same
        # bytes.
        with replacing(Path(path)) as temporary:
            # The library's own file is for its owner's eyes only.
            written = save(arrays, {"adaptune": json.dumps(text | {"header": header})})
            temporary.write_bytes(written)

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a model; a `ModelError` if there is none, it is damaged, or of another adaptune."""
        path = Path(path)
        try:
            header, arrays = _read(path)
            space = load_space(header.pop("space"))
            sets = ParameterSets(space, tuple(header.pop("trials")), tuple(header.pop("sets")))
            arrays["descriptors"] = arrays["descriptors"].astype(np.float32)
            for numbers in ("sequence", "segment"):
                arrays[numbers] = arrays[numbers].astype(np.intp)
            model = cls(sets=sets, **header, **arrays)
            model.check()
        except FileNotFoundError as error:
            raise ModelError(f"{path}: there is no such model; run `adaptune offline`") from error
        except (
            *(OSError, SafetensorError, SpaceError),
            *(ValueError, TypeError, KeyError, OverflowError),
        ) as error:
            what = in_one_line(error)
            raise ModelError(
                f"{path}: is not an error model, or damaged ({what}); run `adaptune offline` again"
            ) from error
        return model

    def check(self) -> None:
        """Refuse a model whose parts do not go together, by a ValueError or a SpaceError."""
        n_frames, n_sets = self.errors.shape
        if self.descriptors.shape != (n_frames, sum(self.blocks.values())):
            raise ValueError("the errors are not of as many frames as the descriptors")
        if not self.sequence.shape == self.segment.shape == (n_frames,):
            raise ValueError("the errors are not of as many frames as the segment numbers")
        if not n_frames or len(self.sets) != n_sets or self.fixed not in self.sets:
            raise ValueError("errors and parameter sets do not go together")
        if self.vectors.shape != (n_frames if self.bank else 0, len(self.bank), 3):
            raise ValueError("the error vectors do not go together with the errors and the bank")
        self._check_sets()
        if not 0 <= self.sequence.min() <= self.sequence.max() < len(self.sequences):
            raise ValueError("a frame is of no sequence")
        # Not a number is neither; both are true of most files, and make no copy of the errors.
        if not np.isfinite(self.descriptors).all() or np.nanmin(self.errors, initial=0.0) < 0.0:
            raise ValueError("there are descriptors or errors that cannot be")
        if np.isnan(self.errors).all(axis=1).any():
            raise ValueError("a frame has no error at all")

    def _check_sets(self) -> None:
        """Refuse a bank that is of no sets of the model, or sets of another space."""
        if self.bank and self.bank_settings.reserve >= len(self.bank):
            raise ValueError("all members of the bank rest")
        if set(self.bank) - set(self.sets) or len(set(self.bank)) != len(self.bank):
            raise ValueError("the bank holds unknown sets, or one twice")
        for parameters in self.sets.parameters:
            self.sets.space.check(parameters)


@cache
def _header_model() -> type[BaseModel]:
    """What the text in a file holds: all but the arrays. Another version may say more."""
    types = get_type_hints(ErrorModel, include_extras=True)
    own: dict[str, Any] = {
        of.name: (types[of.name], ... if of.default is MISSING else of.default)
        for of in fields(ErrorModel)
        if of.name not in _ARRAY_TYPES
    }
    own["space"], own["trials"] = (dict[str, Any], ...), (list[int], ...)
    own["sets"] = (list[dict[str, Any]], ...)
    return create_model("_Header", __config__=ConfigDict(strict=True), **own)


N_BEST = 5
"""Sets to show, besides the fixed one and the bank's."""


def render(model: ErrorModel, path: Path) -> RenderableType:
    """Describe the model in a file: its odometry, and its training."""
    n_frames, n_sets = model.errors.shape
    blocks = ", ".join(f"{name} ({n} numbers)" for name, n in model.blocks.items())
    window = f", as a mean over {model.window} selections in a row" if model.window > 1 else ""
    size = path.stat().st_size / 1e3
    caption = "Mean error over all sequences; a lost track counts as 30 %."
    return Group(
        Text(
            f"Error model of {model.odometry.get('name', 'an odometry')}: {n_sets} parameter sets "
            f"on {n_frames} frames of {', '.join(model.sequences)}, {size:,.0f} kB\n"
            f"Errors over {model.length:g} m. Scans are described by {blocks}{window}."
        ),
        tables.table(f"The best sets of {n_sets}", _sets(model), caption),
        Text("\n".join(_driven(model))),
    )


def _driven(model: ErrorModel) -> Iterator[str]:
    """What is selected along the way."""
    yield f"Recommended: {model.recommended}."
    if len(model.bank) > 1:
        yield f"The bank of `adaptive`: trials {', '.join(map(str, model.bank))}."
    if model.reserve:
        reserve = ", ".join(map(str, model.reserve))
        yield f"Members that work only in new places and after failures: {reserve}."


def _sets(model: ErrorModel) -> list[dict[str, Any]]:
    """The fixed set, the bank's, and the best."""
    means = mean_errors(model.errors, model.sequence)
    best = [model.sets.trials[c] for c in np.argsort(means, kind="stable")[:N_BEST]]
    roles = {model.fixed: ["fixed"]}
    for trial in model.bank:
        roles.setdefault(trial, []).append("bank")
    return [
        {"set": ", ".join((str(n), *roles.get(n, ())))}
        | {"mean [%]": float(means[model.sets.column(n)])}
        | ({} if model.costs is None else {"cost [ms]": model.costs.alone(n)})
        | {"parameters": in_words(model.sets[n])}
        for n in dict.fromkeys([*roles, *best])
    ]
