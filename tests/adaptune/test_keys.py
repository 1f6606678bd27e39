import os
import subprocess
import sys

import pytest

from adaptune.study.config import complete
from offline.config import OfflineStudyConfig

HEAVY = ("scipy", "numba", "open3d", "optuna", "vl_convert", "rosbags", "sklearn", "small_gicp")


@pytest.mark.parametrize(
    ("incomplete", "completed"),
    [
        ("offline.tr", ["offline.trials="]),
        ("offline.sets=", ["offline.sets=shared", "offline.sets=own"]),
        ("offline.sampler=gr", ["offline.sampler=grid"]),
    ],
)
def test_keys_and_values_are_completed(incomplete, completed):
    assert complete(OfflineStudyConfig, incomplete, {"offline.sampler": ["tpe", "grid"]}) == (
        completed
    )


MOST_KEYS = 45
"""Outside of odometries, sequences and courses."""


def test_there_are_no_more_keys_than_a_reader_can_take_in():
    names = [key.rstrip("=") for key in complete(OfflineStudyConfig, "")]
    shared = [n for n in names if n.split(".")[0] not in ("odometry", "sequences", "courses")]
    assert len(shared) <= MOST_KEYS, shared


ZSH = {
    "_ADAPTUNE_COMPLETE": "complete_zsh",
    "_TYPER_COMPLETE_ARGS": "adaptune offline my.yaml -o offline.tr",
}
BASH = {
    "_ADAPTUNE_COMPLETE": "complete_bash",
    "COMP_WORDS": "adaptune offline my.yaml -o offline.tr",
    "COMP_CWORD": "4",
}


@pytest.mark.parametrize("shell", [BASH, ZSH], ids=["bash", "zsh"])
def test_the_shell_is_answered(shell, tmp_path):
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "adaptune"],
        cwd=tmp_path,
        env=os.environ | shell,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "offline.trials=" in done.stdout
    imported = {line.rpartition("|")[2].strip().split(".")[0] for line in done.stderr.splitlines()}
    assert "pydantic" in imported
    assert not imported & set(HEAVY)
