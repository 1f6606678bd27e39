"""Removes the containers of a process that has ended; runs as a script beside that process."""

import sys
import time

_LOOKS, _BETWEEN = 3, 1.0
"""How often it looks for containers, and seconds between: one may just be made."""


def main(label: str) -> None:
    """Wait until the other side of the standard input has ended, then remove what has the label."""
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


if __name__ == "__main__":
    main(sys.argv[1])
