"""Picture of an estimated reference."""

from pathlib import Path

from adaptune.reference.estimated import EstimatedReference
from adaptune.reference.stored import StoredEstimate


def draw_estimate(
    path: Path, title: str, found: EstimatedReference, stored: StoredEstimate
) -> None:
    """Draw the path, its residuals, and where it is not to be trusted."""
