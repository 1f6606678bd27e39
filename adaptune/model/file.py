"""The error model as a file: what passes from training to the robot."""

import hashlib
import io
import json
import math
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, PositiveInt

from adaptune import __version__
from adaptune.archive import compact
from adaptune.descriptor.pca import ScaledPCA
from adaptune.errors import AdaptuneError
from adaptune.files import DAMAGED_NPZ, replacing
from adaptune.model.base import TrainingData
from adaptune.model.paired import Settings
from adaptune.sequence.names import places
from adaptune.space import ParameterSet, ParameterSpace, SpaceError

FORMAT = 4
"""Raised whenever an older adaptune could not read the file, or would read it wrongly."""

SAME_SENSOR = 3.0
"""Degrees by which the lowest points of one sensor's scans may differ between drives."""

_TYPES = {
    "header": ("|u1",),
    "descriptors": ("<u2", "<f4"),
    "sequence": ("<u4",),
    "errors": ("<f4",),
    "vectors": ("<f4",),
}
"""The arrays in a file, and what numbers they may be of."""

_DAMAGED = (*DAMAGED_NPZ, KeyError, OverflowError, SpaceError)
"""What is raised on a file that is not what it says."""


class ModelError(AdaptuneError):
    """A model file that cannot be used."""


class _Header(BaseModel):
    """What is said of the arrays. Later versions may say more in the same format."""

    model_config = ConfigDict(strict=True)

    odometry: dict[str, Any]
    space: dict[str, Any]
    sets: list[dict[str, Any]]
    fixed: int
    length: float = Field(gt=0, allow_inf_nan=False)
    sequences: list[str]
    blocks: dict[str, PositiveInt]
    window: PositiveInt
    elevations: list[float] = []
    paired: Settings = Settings()
    bank: list[int] = []
    fusion: Settings = Settings()
    provenance: dict[str, Any]
    validation: dict[str, Any]


@dataclass(frozen=True, eq=False)
class ErrorModel:
    """Everything that selection needs to know about a study.

    Attributes
    ----------
    odometry : dict
        Name and settings of the odometry.
    space : ParameterSpace
        The parameters that were tuned.
    sets : list of dict
        The parameter sets that were tried.
    fixed : int
        Index of the set that is best over all training sequences.
    length : float
        Metres of a sub-trajectory.
    sequences : list of str
        Names of the training sequences.
    blocks : dict
        By name, in order, how many of the features are each descriptor's.
    window : int
        How many descriptors are averaged, a selection's and those of the selections before.
    descriptors : ndarray of shape (n_frames, n_features)
        float32, averaged.
    sequence : ndarray of shape (n_frames,)
        Number of each frame's sequence.
    errors : ndarray of shape (n_frames, n_sets)
        float32 percent, infinite where the track was lost, NaN where the set was never run.
    provenance : dict
        Where the model comes from, for people.
    bank : list of int, optional
        The sets whose errors cancel each other best, the fixed one first; see
        `adaptune.model.fusion.bank`; empty if there is no bank.
    vectors : ndarray of shape (n_frames, len(bank), 3), optional
        float32, their errors as vectors; see `TrainingData`.
    elevations : list of float, optional
        For each training sequence, degrees at which its scans' lowest points lie, see
        `adaptune.descriptor.lowest_elevation`; empty if that is not known.
    paired, fusion : Settings
        Of the paired rule, and of the bank's weights, chosen on the training sequences.
    validation : dict
        By selection rule what `adaptune validate` found, for people; empty before.
    """

    odometry: dict[str, Any]
    space: ParameterSpace
    sets: list[ParameterSet]
    fixed: int
    length: float
    sequences: list[str]
    blocks: dict[str, int]
    window: int
    descriptors: NDArray[np.float32]
    sequence: NDArray[np.intp]
    errors: NDArray[np.float32]
    provenance: dict[str, Any]
    bank: list[int] = field(default_factory=list)
    vectors: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 0, 3), np.float32))
    elevations: list[float] = field(default_factory=list)
    paired: Settings = field(default_factory=Settings)
    fusion: Settings = field(default_factory=Settings)
    validation: dict[str, Any] = field(default_factory=dict)

    def pca(self) -> ScaledPCA:
        """Principal components of the training frames' descriptors."""
        return ScaledPCA(blocks=tuple(self.blocks.values())).fit(self.descriptors)

    def training_data(self, pca: ScaledPCA, members: list[int] | None = None) -> TrainingData:
        """What selection rules learn from.

        Parameters
        ----------
        pca
            Of `pca`.
        members
            Of `bank`, those that are driven, the first of which counts as the fixed one; all
            sets, and the fixed one, when left out.
        """
        data = TrainingData(
            pca.transform(self.descriptors),
            places(self.sequences)[self.sequence],
            self.errors,
            self.space.to_unit(self.sets),
            self.fixed,
        )
        if members is None:
            return data
        vectors = self.vectors[:, [self.bank.index(i) for i in members]]
        return replace(data, fixed=members[0], candidates=members, vectors=vectors)

    def thinned(self, max_frames: int | None) -> Self:
        """Keep fewer frames, so that a selection costs less.

        Of each sequence its share, at least one, as far from each other in time: so mean errors
        stay what they are. (Frames that cover what all of them look like would be rare ones.) The
        paired rule and the bank ask for as much fewer of them.

        Parameters
        ----------
        max_frames
            How many to keep, over all sequences, but one of each at least; all if None.
        """
        n_frames = len(self.sequence)
        if max_frames is None or n_frames <= max_frames:
            return self
        kept = []
        for s in np.unique(self.sequence):
            members = np.flatnonzero(self.sequence == s)
            share = max(1, max_frames * len(members) // n_frames)
            kept.append(members[(2 * np.arange(share) + 1) * len(members) // (2 * share)])
        # In their order, for what follows may ask for it.
        frames = np.sort(np.concatenate(kept))
        share_kept = len(frames) / n_frames

        def fewer(settings: Settings) -> Settings:
            n_near = max(1, round(settings.n_frames * share_kept))
            return settings.model_copy(update={"n_frames": n_near})

        return replace(
            self,
            paired=fewer(self.paired),
            fusion=fewer(self.fusion),
            descriptors=self.descriptors[frames],
            sequence=self.sequence[frames],
            errors=self.errors[frames],
            vectors=self.vectors[frames] if self.bank else self.vectors,
        )

    @property
    def trials(self) -> list[int]:
        """Numbers of the trials that the sets are of; those of the sets where it is not told."""
        told = self.provenance.get("trials")
        if isinstance(told, list) and len(told) == len(self.sets):
            return told
        return list(range(len(self.sets)))

    @property
    def bank_trials(self) -> list[int]:
        """Numbers of the trials that the bank's sets are of."""
        return [self.trials[i] for i in self.bank]

    def number(self, named: int | ParameterSet) -> int | None:
        """Number of a trial's set, or of a set that is named by what differs from the baseline.

        None if the model does not know it.
        """
        if isinstance(named, int):
            return self.trials.index(named) if named in self.trials else None
        whole = self.space.baseline | named
        return self.sets.index(whole) if whole in self.sets else None

    def check_study(self, odometry: dict[str, Any], space: ParameterSpace, path: Path) -> None:
        """Refuse a model that was not made for this odometry and these parameters.

        Parameters
        ----------
        odometry
            Its name and settings.
        space
            The parameters.
        path
            Where the model is from.

        Raises
        ------
        ModelError
        """
        if self.odometry != odometry:
            raise ModelError(
                f"{path}: is a model of {json.dumps(self.odometry)}, the study's odometry is "
                f"{json.dumps(odometry)}; run `adaptune offline` for this study"
            )
        if self.space != space:
            raise ModelError(
                f"{path}: is a model of other parameters or ranges than the study's; run `adaptune "
                f"offline` for this study"
            )

    def is_foreign(self, elevation: float) -> bool:
        """Whether scans whose lowest points lie there come from no sensor of the training's.

        Parameters
        ----------
        elevation
            Degrees, the median of some scans' `adaptune.descriptor.lowest_elevation`.
        """
        apart = [abs(elevation - known) for known in self.elevations]
        return bool(apart) and min(apart) > SAME_SENSOR

    def _arrays(self) -> dict[str, Any]:
        return {
            "descriptors": np.ascontiguousarray(compact(self.descriptors)),
            "sequence": self.sequence.astype(np.uint32),
            "errors": np.ascontiguousarray(self.errors, np.float32),
            "vectors": np.ascontiguousarray(self.vectors, np.float32),
        }

    def _header(self) -> dict[str, Any]:
        return {
            "odometry": self.odometry,
            "space": self.space.dump(),
            "sets": self.sets,
            "fixed": self.fixed,
            "length": self.length,
            "sequences": self.sequences,
            "blocks": self.blocks,
            "window": self.window,
            "elevations": self.elevations,
            "paired": self.paired.model_dump(),
            "bank": self.bank,
            "fusion": self.fusion.model_dump(),
        }

    @property
    def digest(self) -> str:
        """Of everything that selections depend on."""
        digest = hashlib.sha256(json.dumps(self._header()).encode())
        for array in self._arrays().values():
            digest.update(array.data)
        return digest.hexdigest()[:16]

    def save(self, path: Path) -> None:
        """Write the model to one ``.npz`` file: plain arrays and JSON, neither pickled nor packed.

        Numbers keep all their bits. A packed file would be a tenth smaller, take ten times as long
        to load, and could ask for a thousand times its size in memory.
        """
        header = {"format": FORMAT, "adaptune": __version__} | self._header()
        header |= {"provenance": self.provenance, "validation": self.validation}
        # numpy adds a suffix to a name, but not to an open file.
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez(file, header=_bytes(header), **self._arrays())

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a model.

        It takes about as much memory as the file is large, whatever the file says.

        Raises
        ------
        ModelError
            If there is none, or it is damaged, or of a newer or older adaptune.
        """
        try:
            with path.open("rb") as stream, zipfile.ZipFile(stream) as file:
                size = stream.seek(0, io.SEEK_END)
                said = json.loads(_read(file, size, "header").tobytes())
                _check_format(path, int(said["format"]), str(said["adaptune"]))
                header = _Header.model_validate(said)
                model = cls(
                    odometry=header.odometry,
                    space=ParameterSpace.load(header.space),
                    sets=header.sets,
                    fixed=header.fixed,
                    length=header.length,
                    sequences=header.sequences,
                    blocks=header.blocks,
                    window=header.window,
                    descriptors=_read(file, size, "descriptors").astype(np.float32),
                    sequence=_read(file, size, "sequence").astype(np.intp),
                    errors=_read(file, size, "errors"),
                    bank=header.bank,
                    vectors=_read(file, size, "vectors"),
                    provenance=header.provenance,
                    elevations=header.elevations,
                    paired=header.paired,
                    fusion=header.fusion,
                    validation=header.validation,
                )
                model.check()
        except FileNotFoundError as error:
            raise ModelError(f"{path}: there is no such model; run `adaptune offline`") from error
        except _DAMAGED as error:
            lines = " ".join(str(error).split())
            raise ModelError(
                f"{path}: is not an error model, or damaged ({lines}); run `adaptune offline` again"
            ) from error
        return model

    def check(self) -> None:
        """Refuse a model whose parts do not go together.

        Raises
        ------
        ValueError
        SpaceError
        """
        n_frames, n_sets = self.errors.shape
        if self.descriptors.shape != (n_frames, sum(self.blocks.values())):
            raise ValueError("the errors are not of as many frames as the descriptors")
        if self.sequence.shape != (n_frames,):
            raise ValueError("the errors are not of as many frames as the sequence numbers")
        if not n_frames or len(self.sets) != n_sets or not 0 <= self.fixed < n_sets:
            raise ValueError("errors and parameter sets do not go together")
        if self.vectors.shape != (n_frames if self.bank else 0, len(self.bank), 3):
            raise ValueError(
                "the error vectors are not of as many frames as the errors, and the bank"
            )
        if set(self.bank) - set(range(n_sets)) or len(set(self.bank)) != len(self.bank):
            raise ValueError("the bank holds sets that there are not, or one twice")
        if not 0 <= self.sequence.min() <= self.sequence.max() < len(self.sequences):
            raise ValueError("a frame is of no sequence")
        # Not a number is neither; both are true of most files, and make no copy of the errors.
        if not np.isfinite(self.descriptors).all() or np.nanmin(self.errors, initial=0.0) < 0.0:
            raise ValueError("there are descriptors or errors that cannot be")
        if np.isnan(self.errors).all(axis=1).any():
            raise ValueError("a frame has no error at all")
        for parameters in self.sets:
            self.space.check(parameters)


def _bytes(data: Any) -> NDArray[np.uint8]:
    return np.frombuffer(json.dumps(data).encode(), np.uint8)


def _check_format(path: Path, found: int, version: str) -> None:
    if found > FORMAT:
        raise ModelError(
            f"{path}: written by adaptune {version}, which is newer than this ({__version__}); "
            f"update adaptune or fit the model again"
        )
    if found < FORMAT:
        raise ModelError(
            f"{path}: written by an older adaptune ({version}); run `adaptune offline` again, "
            f"which fits the model to the trials there are"
        )


def _read(file: zipfile.ZipFile, size: int, name: str) -> NDArray[Any]:
    """Read an array, of which nothing is believed that the file's `size` does not bear out.

    It cannot be written to.
    """
    member = file.getinfo(f"{name}.npy")
    if member.compress_type != zipfile.ZIP_STORED or member.file_size != member.compress_size:
        raise ValueError(f"{name} is packed, as other programs and older versions do")
    if member.file_size > size:
        raise ValueError(f"{name} is said to be longer than the file")
    data = file.read(member)
    stream = io.BytesIO(data)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError(f"{name} is of another version of numpy's format")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    begin = stream.tell()
    if dtype.str not in _TYPES[name] or fortran:
        raise ValueError(f"{name} holds {dtype}, not {' or '.join(_TYPES[name])}")
    if math.prod(shape) * dtype.itemsize != len(data) - begin:
        raise ValueError(f"{name} is not as long as it says")
    return np.frombuffer(data, dtype, offset=begin).reshape(shape)
