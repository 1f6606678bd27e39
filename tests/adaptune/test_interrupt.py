import os
import signal
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "module", ["typer.core", "rich.console", "pydantic", "numpy", "offline.config"]
)
def test_ctrl_c_while_importing_ends_without_a_traceback(study_file, tmp_path, module):
    # Python names every module to standard error once it is imported.
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "adaptune", "offline", str(study_file)],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # What runs in a shell's background is told to ignore it.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )
    assert any(line.rpartition("|")[2].strip() == module for line in process.stderr)
    os.kill(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 130
    assert said.endswith("interrupted\n")
    assert "Traceback" not in said
    assert not (tmp_path / "runs").exists()
