"""The command line, called in the process of the tests."""

from click.testing import Result
from typer.testing import CliRunner

from adaptune.commands.cli import app


def call(*arguments: object) -> Result:
    """Run a command line; an exception that it does not tell of fails the test."""
    return CliRunner().invoke(app, list(map(str, arguments)), catch_exceptions=False)
