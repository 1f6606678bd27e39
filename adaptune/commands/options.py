"""Arguments that all commands on a study share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from adaptune.errors import AdaptuneError

if TYPE_CHECKING:
    from offline.offline_study import OfflineStudy

StudyFile = Annotated[
    Path,
    typer.Argument(metavar="STUDY", help="The study's YAML, or its folder.", show_default=False),
]


def _complete_override(incomplete: str) -> list[str]:
    """Keys and values for `-o`, when the shell asks."""
    from adaptune.study.keys import complete
    from offline.config import OfflineStudyConfig
    from offline.samplers.settings import NAMES

    return complete(OfflineStudyConfig, incomplete, {"offline.sampler": NAMES})


Override = Annotated[
    list[str],
    typer.Option(
        "-o",
        "--override",
        metavar="KEY=VALUE",
        help="Replace a value of the YAML, as in `-o offline.trials=128`. May be repeated.",
        show_default=False,
        autocompletion=_complete_override,
    ),
]
Folder = Annotated[
    Path | None,
    typer.Option(
        help="The study's folder.", show_default="the YAML's name, under runs/", file_okay=False
    ),
]


def load(path: Path, overrides: list[str], folder: Path | None) -> "OfflineStudy":
    """Load the study of a YAML file, or of the folder of a study that has begun."""
    from offline.offline_study import load_study

    if not path.exists():
        what = "give the YAML of a study, or the folder of one that has begun"
        raise AdaptuneError(f"{path}: there is no such file or folder; {what}")
    if path.is_dir():
        if not (path / "study.yaml").exists():
            raise AdaptuneError(f"{path}: is no study's folder: there is no study.yaml in it")
        path, folder = path / "study.yaml", folder or path
    return load_study(path, overrides, folder)
