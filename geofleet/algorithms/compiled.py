"""How the loops of this package are compiled: once a machine, and to no more than what calls them needs.

Numba also makes a wrapper for C, which nobody calls here and which takes a sixth of the time that a first run compiles.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

from numba import njit

if TYPE_CHECKING:
    from collections.abc import Callable

Loop = TypeVar("Loop", bound="Callable[..., Any]")
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "no_cfunc_wrapper": True}


def kernel(loop: Loop) -> Loop:
    """Compile a loop when it is first called, and keep it on disk."""
    compiled: Loop = njit(**_OPTIONS)(loop)
    return compiled


def inlined_kernel(loop: Loop) -> Loop:
    """Compile a short loop into its callers: a call would hand over each part of every array.

    LLVM puts it there; Numba's own way (`inline="always"`) types and lowers it anew at every call.
    """
    compiled: Loop = njit(**_OPTIONS, forceinline=True)(loop)
    return compiled
