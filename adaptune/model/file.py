"""The error model as a file: what passes from training to the robot."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from adaptune import __version__
from adaptune.descriptor import N_FEATURES, ScaledPCA
from adaptune.errors import AdaptuneError
from adaptune.files import DAMAGED_NPZ, replacing
from adaptune.model.base import TrainingData
from adaptune.space import ParameterSet, ParameterSpace, SpaceError

FORMAT = 1
"""Raised whenever an older adaptune could not read the file, or would read it wrongly."""


_DAMAGED = (*DAMAGED_NPZ, KeyError, AttributeError, SpaceError)
"""What is raised, besides, on a header that is not a model's."""


class ModelError(AdaptuneError):
    """A model file that cannot be used."""


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
    histograms : ndarray of shape (n_frames, 90)
    sequence : ndarray of shape (n_frames,)
        Number of each frame's sequence.
    errors : ndarray of shape (n_frames, n_sets)
        float32 percent, infinite where the track was lost.
    provenance : dict
        Where the model comes from, for people.
    """

    odometry: dict[str, Any]
    space: ParameterSpace
    sets: list[ParameterSet]
    fixed: int
    length: float
    sequences: list[str]
    histograms: NDArray[np.float64]
    sequence: NDArray[np.intp]
    errors: NDArray[np.float32]
    provenance: dict[str, Any]

    def describe(self) -> ScaledPCA:
        """Principal components of the training frames' histograms."""
        return ScaledPCA().fit(self.histograms)

    def training_data(self, pca: ScaledPCA) -> TrainingData:
        """What selection rules learn from."""
        return TrainingData(
            pca.transform(self.histograms),
            self.sequence,
            self.errors,
            self.space.to_unit(self.sets),
            self.fixed,
        )

    def save(self, path: Path) -> None:
        """Write the model to one ``.npz`` file, without pickle."""
        header = {
            "format": FORMAT,
            "adaptune": __version__,
            "odometry": self.odometry,
            "space": self.space.dump(),
            "fixed": self.fixed,
            "length": self.length,
            "sequences": self.sequences,
            "provenance": self.provenance,
            "sets": self.sets,
        }
        # numpy adds a suffix to a name, but not to an open file.
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(
                file,
                header=np.frombuffer(json.dumps(header).encode(), np.uint8),
                # Counts of cells are small whole numbers.
                histograms=self.histograms.astype(np.uint16),
                sequence=self.sequence.astype(np.uint32),
                errors=self.errors,
            )

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read a model.

        Raises
        ------
        ModelError
            If there is none, or it is damaged, or of a newer adaptune.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                header = json.loads(file["header"].tobytes())
                if header["format"] > FORMAT:
                    raise ModelError(
                        f"{path}: written by adaptune {header['adaptune']}, which is newer than "
                        f"this ({__version__}); update adaptune or fit the model again"
                    )
                model = cls(
                    odometry=header["odometry"],
                    space=ParameterSpace.load(header["space"]),
                    sets=header["sets"],
                    fixed=header["fixed"],
                    length=header["length"],
                    sequences=header["sequences"],
                    histograms=file["histograms"].astype(np.float64),
                    sequence=file["sequence"].astype(np.intp),
                    errors=file["errors"],
                    provenance=header["provenance"],
                )
                model.check()
        except FileNotFoundError as error:
            raise ModelError(f"{path}: there is no such model") from error
        except _DAMAGED as error:
            raise ModelError(f"{path}: is not an error model, or damaged ({error})") from error
        return model

    def check(self) -> None:
        """Refuse a model whose parts do not go together.

        Raises
        ------
        ValueError
        SpaceError
        """
        n_frames, n_sets = self.errors.shape
        if self.histograms.shape != (n_frames, N_FEATURES) or self.sequence.shape != (n_frames,):
            raise ValueError("histograms, sequence numbers and errors differ in length")
        if not n_frames or len(self.sets) != n_sets or not 0 <= self.fixed < n_sets:
            raise ValueError("errors and parameter sets do not go together")
        if self.sequence.max() >= len(self.sequences) or np.isnan(self.errors).any():
            raise ValueError("a frame is of no sequence, or has no error")
        for parameters in self.sets:
            self.space.check(parameters)
