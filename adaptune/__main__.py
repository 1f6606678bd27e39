"""Start the command line; Ctrl-C ends it at once until a command begins its work."""

import os
import signal
import sys


def _leave(*_: object) -> None:
    # An exception within an import would become others.
    os.write(sys.stderr.fileno(), b"interrupted\n")
    os._exit(130)


def main() -> None:
    """Run the command line."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)
    from adaptune.commands import cli

    cli.main()


if __name__ == "__main__":
    main()
