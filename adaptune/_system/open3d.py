"""Open3D, imported where it is used, and on machines that lack what it looks for."""

import ctypes
from functools import cache
from typing import Any

from adaptune.errors import import_extra


@cache
def load() -> Any:
    """Import ``open3d``, which takes about a second, and let it report errors only.

    Its compiled part needs ``libusb-1.0.so.0``, which a fresh machine does not have. A
    NotInstalledError says how to install it.
    """
    (libusb,) = import_extra("open3d", "libusb_package")
    ctypes.CDLL(str(libusb.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    (open3d,) = import_extra("open3d", "open3d")
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
