"""Open3D, imported where it is used and on machines without libusb."""

import ctypes
from functools import cache
from typing import Any


@cache
def load() -> Any:
    """Import ``open3d``, which takes about a second, and let it report errors only.

    Its compiled part needs ``libusb-1.0.so.0``, which a fresh machine does not have.
    """
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    import open3d

    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
