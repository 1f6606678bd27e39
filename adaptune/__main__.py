"""Start the command line; Ctrl-C while it is being imported ends it as later on."""

import sys


def main() -> None:
    """Run the command line."""
    try:
        from adaptune.cli import app

        app(prog_name="adaptune")
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        sys.exit(130)


if __name__ == "__main__":
    main()
