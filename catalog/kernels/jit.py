"""How functions of the kernels are compiled by numba: import this only when one is needed.

Fast-math leaves out ``nnan`` and ``ninf``: NaN positions must give NaN answers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """The function compiled to machine code, without the interpreter lock, kept on disk."""
    options = {"contract", "reassoc", "nsz", "arcp"}
    jit: Any = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=options)
    return cast(_Function, jit(function))
