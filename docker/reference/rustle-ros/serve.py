#!/usr/bin/env python3
"""Serve the odometry on a Unix socket, by the protocol of `adaptune.odometry.wire`."""

import signal
import socket
import sys
import threading

from adaptune._system.processes import answer_all
from adaptune.odometry.registry import converse


def main() -> None:
    """Serve until the program is told to end."""
    if len(sys.argv) != 2:
        sys.exit("usage: odometry-serve PATH")
    # The first process of a container has no default for it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(sys.argv[1])
        server.listen()
        sys.stderr.write(f"unix:{sys.argv[1]}\n")
        while True:
            connection, _ = server.accept()
            threading.Thread(target=answer, args=(connection,), daemon=True).start()


def answer(connection: socket.socket) -> None:
    """Be an instance for whoever has connected."""
    with connection, connection.makefile("rb") as reader, connection.makefile("wb") as writer:
        answer_all(reader, writer, converse("gicp"))


if __name__ == "__main__":
    main()
