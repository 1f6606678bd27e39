"""Files of error models: arrays and text in the safetensors format, which runs no code on load."""

import hashlib
import json
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from adaptune import __version__
from adaptune.errors import AdaptuneError
from adaptune.files import replacing

FORMAT = 6
"""Raised whenever an older adaptune could not read the file, or would read it wrongly."""

DAMAGED = (SafetensorError, ValueError, TypeError, KeyError, OverflowError)
"""What is raised on a file whose content does not fit together."""

Arrays = Mapping[str, NDArray[Any]]


class ModelError(AdaptuneError):
    """A model file that cannot be used."""


def digest(header: Mapping[str, Any], arrays: Arrays) -> str:
    """Digest of a header and arrays, in hexadecimal."""
    found = hashlib.sha256(json.dumps(header).encode())
    for name in sorted(arrays):
        found.update(np.ascontiguousarray(arrays[name]).data)
    return found.hexdigest()[:16]


def checksum(header: Mapping[str, Any], arrays: Arrays) -> int:
    """CRC-32 of a header and arrays, which shows damage."""
    found = zlib.crc32(json.dumps(header).encode())
    for name in sorted(arrays):
        found = zlib.crc32(np.ascontiguousarray(arrays[name]).data, found)
    return found


def write_model_file(path: Path, header: Mapping[str, Any], arrays: Arrays) -> None:
    """Write a header and arrays.

    The numbers are not compressed: a compressed file would be a tenth smaller, take ten times as
    long to load, and could demand a thousand times its size in memory.
    """
    text = {
        "format": FORMAT,
        "version": __version__,
        "checksum": checksum(header, arrays),
        "header": header,
    }
    # The format keeps no order of several entries, and the same model shall have the same bytes.
    with replacing(path) as temporary:
        save_file(dict(arrays), temporary, {"adaptune": json.dumps(text)})


def read_model_file(
    path: Path, types: Mapping[str, tuple[str, ...]]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a header and arrays.

    It takes about as much memory as the file is large, whatever the file says.

    Parameters
    ----------
    path
        The file.
    types
        The arrays to read, and the types that each may have.

    Raises
    ------
    ModelError
        If the file is of a newer or older adaptune.
    OSError, SafetensorError, ValueError, TypeError, KeyError, OverflowError
        If there is no such file, or it is damaged.
    """
    with path.open("rb"), safe_open(path, "np") as file:
        text = json.loads((file.metadata() or {})["adaptune"])
        _check_format(path, int(text["format"]), str(text["version"]))
        header = dict(text["header"])
        arrays = {name: file.get_tensor(name) for name in sorted(file.keys())}
    if checksum(header, arrays) != text["checksum"]:
        raise ValueError("its content is not what was written")
    for name, known in types.items():
        if arrays[name].dtype.str not in known:
            raise ValueError(f"{name} holds {arrays[name].dtype}, not {' or '.join(known)}")
    return header, {name: arrays[name] for name in types}


def _check_format(path: Path, found: int, version: str) -> None:
    if found > FORMAT:
        raise ModelError(
            f"{path}: written by adaptune {version}, which is newer than this ({__version__}); "
            f"update adaptune, or fit the model again"
        )
    if found < FORMAT:
        raise ModelError(
            f"{path}: written by an older adaptune ({version}); run `adaptune offline` again, "
            f"which fits the model to the finished trials"
        )
