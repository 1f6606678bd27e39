"""The command line, called in the process of the tests."""

from click.testing import Result
from typer.testing import CliRunner

from adaptune.commands.cli import app


def call(*arguments: object) -> Result:
    """Run a command line; an exception that it does not tell of fails the test."""
    return CliRunner().invoke(app, list(map(str, arguments)), catch_exceptions=False)


def succeeded(*arguments: object) -> Result:
    """Run a command line that does what it is asked to."""
    done = call(*arguments)
    assert done.exit_code == 0, done.output
    return done


def refused(*arguments: object) -> str:
    """Run a command line that ends with 2; returns what it says about it, on one line."""
    done = call(*arguments)
    assert done.exit_code == 2, done.output
    assert "Traceback" not in done.stderr
    return " ".join(done.stderr.split())
