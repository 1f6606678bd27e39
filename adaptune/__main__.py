"""Start the command line; Ctrl-C ends it at once until a command begins its work."""

import os
import resource
import signal
import sys

_OPEN_FILES = 1 << 16


def _leave(*_: object) -> None:
    # An exception within an import would become others.
    os.write(sys.stderr.fileno(), b"interrupted\n")
    os._exit(130)


def main() -> None:
    """Run the command line; a user's classes are found in the working folder, after all others."""
    here = os.getcwd()  # noqa: PTH109 - what this imports may not have the name of a file here
    if here != __file__.removesuffix("/adaptune/__main__.py"):  # a checkout runs what it holds
        sys.path[:] = [*(folder for folder in sys.path if folder not in ("", here)), here]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _leave)
    # A recording may have more parts than the 1024 files that most systems begin with.
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = _OPEN_FILES if hard < 0 else min(hard, _OPEN_FILES)
    if 0 <= soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
    try:
        from adaptune.commands import cli

        cli.main()
    except ImportError as error:
        from adaptune.errors import hidden

        if not (said := hidden(error)):
            raise
        sys.stderr.write(f"error: {error}: {said}\n")
        sys.exit(2)


if __name__ == "__main__":
    main()
