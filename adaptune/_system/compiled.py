"""Loops that numba compiles, on machines without a folder for them, too."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

_Loop = TypeVar("_Loop", bound=Callable[..., Any])


def compiled(loop: _Loop, signature: Any = None) -> _Loop:
    """Compile a loop with numba; with a signature at once, and to run beside other threads.

    It is kept for later processes where there is a folder that can be written to.
    """
    import numba

    compiler: Any = partial(numba.njit, signature, nogil=signature is not None)
    try:
        return compiler(cache=True)(loop)  # type: ignore[no-any-return]
    except RuntimeError:  # numba's "no locator available"
        return compiler()(loop)  # type: ignore[no-any-return]
