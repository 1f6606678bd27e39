"""Files that are there whole or not at all."""

import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

DAMAGED_NPZ = (
    OSError,
    ValueError,
    TypeError,
    EOFError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What numpy and zipfile raise on ``.npz`` files that are not what they say."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Write a file beside its place and rename it there when all went well.

    Parameters
    ----------
    path
        Where the file shall be; its folder is made when there is none.

    Yields
    ------
    Path
        An unused name in the same folder with the same suffix. The file there replaces `path` in
        one step when the block ends, and is removed when the block raises.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    beside = Path(name)
    try:
        yield beside
        # mkstemp makes the file private; what a user receives is as readable as any new file.
        umask = os.umask(0)
        os.umask(umask)
        beside.chmod(0o666 & ~umask)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Fill a folder beside its place and rename it there when all went well.

    Parameters
    ----------
    path
        Where the folder shall be; one that is there is replaced.

    Yields
    ------
    Path
        An unused name in the same folder, for the block to make a folder of.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as name:
        beside = Path(name) / "new"
        yield beside
        if path.exists():
            path.rename(Path(name) / "old")
        beside.rename(path)


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` in UTF-8, whole or not at all."""
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")
