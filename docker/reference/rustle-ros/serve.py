#!/usr/bin/env python3
"""Serve the odometry on a Unix socket, by the protocol of `adaptune.odometry.wire`."""

import signal
import sys

from adaptune.odometry.serving import listen


def main() -> None:
    """Serve until the program is told to end."""
    if len(sys.argv) != 2:
        sys.exit("usage: odometry-serve PATH")
    # The first process of a container has no default for it.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    listen(f"unix:{sys.argv[1]}", "gicp", lambda address: sys.stderr.write(f"{address}\n"))


if __name__ == "__main__":
    main()
