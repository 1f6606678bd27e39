"""The command line."""

import logging
from typing import Annotated, Any

import typer

from adaptune.commands import evaluate, offline, online, tune, watch
from adaptune.commands.terminal import Commands, errors, say

# Every command imports what it needs, so that `adaptune --help` answers at once.

app = typer.Typer(
    context_settings={"help_option_names": ["-h", "--help"]},
    name="adaptune",
    cls=Commands,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help=(
        "Tune the parameters of a LiDAR odometry, and keep tuning them while the robot drives.\n\n"
        "A study is a YAML file: an odometry, its parameters, and sequences for training and test. "
        "Its folder keeps all results. Run the same command again to resume it.\n\n"
        "Every command names the next one at its end; the first is `adaptune tune my.bag`."
    ),
)

for _command in (
    *(tune.tune, tune.inspect, evaluate.evaluate, offline.simulate, offline.reference),
    *(offline.offline, offline.trials, offline.validate, offline.cost),
    *(online.online, online.compare, online.record, watch.watch),
    offline.import_rustle,
):
    app.command()(_command)


def _version(show: bool) -> None:
    if show:
        import adaptune

        say(f"adaptune {adaptune.__version__}")
        raise typer.Exit


@app.callback()
def _main(
    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Show more messages.")] = False,
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    from rich.highlighter import NullHighlighter
    from rich.logging import RichHandler

    plain: Any = {"markup": False, "highlighter": NullHighlighter(), "keywords": []}
    # In a file, rich would pad every line to the console's width.
    bars = errors.is_terminal
    rich = RichHandler(console=errors, show_path=False, show_level=False, **plain)
    logging.basicConfig(
        level=logging.DEBUG if verbose else logging.INFO,
        format="%(message)s" if bars else "%(asctime)s %(message)s",
        datefmt="[%X]",
        handlers=[rich if bars else logging.StreamHandler()],
    )
    for chatty in ("numba", "asyncio"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


def main() -> None:
    """Run the command line."""
    app(prog_name="adaptune")


if __name__ == "__main__":
    main()
