"""How a study describes a sequence."""

import os
import re
from pathlib import Path
from typing import Annotated, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ValidationInfo,
    model_validator,
)

from adaptune.sequence.bag import BagSequence, SequenceError

_REFERENCE_FILES = (".tum", ".txt")


def resolve(path: str, info: ValidationInfo) -> str:
    """Make a path absolute: variables and ~ replaced, relative to the folder of the study's file.

    Raises
    ------
    ValueError
        Naming the environment variable that is not set.
    """
    if unset := [v for v in re.findall(r"\$\{(\w+)\}", path) if v not in os.environ]:
        raise ValueError(f"the environment variable {unset[0]} is not set")
    folder = (info.context or {}).get("folder", Path())
    return str((Path(folder) / Path(os.path.expandvars(path)).expanduser()).resolve())


def _resolve_file(reference: str, info: ValidationInfo) -> str:
    return resolve(reference, info) if reference.endswith(_REFERENCE_FILES) else reference


class SequenceConfig(BaseModel):
    """A recording and what of it to use.

    Attributes
    ----------
    bag : str
        Path of the bag.
    points : str, optional
        Topic of the point clouds.
    reference : str, optional
        Topic of the reference poses, or a TUM file (``.tum``, ``.txt``).
    start, stop : float
        Seconds since the first scan.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    bag: Annotated[str, AfterValidator(resolve)]
    points: str | None = None
    reference: Annotated[str, AfterValidator(_resolve_file)] | None = None
    start: float = Field(0.0, ge=0)
    stop: float | None = Field(None, gt=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.stop is not None and self.stop <= self.start:
            raise ValueError(f"start ({self.start:g}) must be less than stop ({self.stop:g})")
        return self


def open_sequence(config: SequenceConfig) -> BagSequence:
    """Open what a study describes.

    Raises
    ------
    SequenceError
        If it cannot be opened as described.
    """
    reference: str | Path | None = config.reference
    if isinstance(reference, str) and reference.endswith(_REFERENCE_FILES):
        reference = Path(reference)
        if not reference.is_file():
            raise SequenceError(f"{reference}: there is no such file")
    return BagSequence(Path(config.bag), config.points, reference, config.start, config.stop)
