"""Removes what a process that has ended leaves: containers, and folders that it shared with them.

It runs as a script beside that process.
"""

import shutil
import sys
import time
from pathlib import Path

_LOOKS, _BETWEEN = 3, 1.0
"""How often it looks for containers, and seconds between: one may just be made."""


def main(label: str, prefix: str) -> None:
    """When the standard input ends, remove containers with a label, and folders with a prefix."""
    sys.stdin.buffer.read()
    from docker import DockerClient
    from docker.errors import APIError

    engine = DockerClient.from_env()
    for look in range(_LOOKS):
        for container in engine.api.containers(quiet=True, all=True, filters={"label": label}):
            try:
                engine.api.remove_container(container["Id"], v=True, force=True)
            except APIError:
                continue  # it is being removed
        if look < _LOOKS - 1:
            time.sleep(_BETWEEN)
    begin = Path(prefix)
    for folder in begin.parent.glob(f"{begin.name}*"):
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
