"""A study with the settings of the offline stage."""

from collections.abc import Sequence
from pathlib import Path

from adaptune.study.loading import read_study
from adaptune.study.study import Study
from offline.config import OfflineStudyConfig

OfflineStudy = Study[OfflineStudyConfig]
"""A study with the settings of the offline stage."""


def load_study(
    path: Path | str,
    overrides: Sequence[str] = (),
    folder: Path | None = None,
    runs: Path = Path("runs"),
) -> OfflineStudy:
    """Read and check the whole YAML of a study, see `adaptune.study.loading.read_study`."""
    return read_study(Path(path), OfflineStudyConfig, overrides, folder, runs)
