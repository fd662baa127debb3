"""Compiles hot loops; all compiled code of the project uses this decorator.

    @compiled
    def sum_of_squares(x: Array) -> float:
        total = 0.0
        for i in range(x.shape[0]):
            total += x[i] * x[i]
        return total

A compiled function has type annotations, which mypy checks, and must be called with one set of argument types only,
because numba compiles it again for every other set. The machine code is stored on disk, see `hal.kernel_cache`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast, overload

import numba
import numpy as np
from numba.core import event
from numba.core.registry import cpu_target
from numba.extending import register_jitable

from hal import kernel_cache, pauses

kernel_cache.use(numba.config)

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T", bool, int)


class _Compiling(event.Listener):
    """Declares a pause while the compiler works, because it holds the lock of Python."""

    def on_start(self, event: object) -> None:  # noqa: ARG002 - an interface
        pauses.begin()

    def on_end(self, event: object) -> None:  # noqa: ARG002 - an interface
        pauses.end()


event.register("numba:compiler_lock", _Compiling())  # type: ignore[no-untyped-call]  # numba has no types

REORDERED = frozenset({"reassoc", "contract", "nsz", "arcp"})
"""For `fastmath`: the terms of a sum may be added in another order; NaN and infinity keep their meaning."""


@overload
def compiled(function: F, /) -> F: ...
@overload
def compiled(*, fastmath: frozenset[str]) -> Callable[[F], F]: ...


def compiled(function: F | None = None, /, *, fastmath: frozenset[str] = frozenset()) -> F | Callable[[F], F]:
    """Compile a function on its first call and store the machine code on disk.

    Division by zero gives infinity or NaN as in numpy. The interpreter lock is released while the function runs.

    Args:
        function: the function, when the decorator is used without arguments.
        fastmath: floating-point transformations that the compiler may use, see `REORDERED`.
    """

    def compile_one(plain_function: F) -> F:
        compiler = numba.njit(cache=True, error_model="numpy", nogil=True, fastmath=set(fastmath) or False)
        return cast(F, compiler(plain_function))

    return compile_one if function is None else compile_one(function)


@overload
def inlined(function: F, /) -> F: ...
@overload
def inlined(*, early: bool) -> Callable[[F], F]: ...


def inlined(function: F | None = None, /, *, early: bool = False) -> F | Callable[[F], F]:
    """Let compiled functions call a small helper; it is compiled into each of them and stays plain Python elsewhere.

    Args:
        function: the helper, when the decorator is used without arguments.
        early: copy the helper's statements into the caller before types are known. This takes longer to compile. It
            pays in the innermost loop for a helper with arrays as arguments, because passing them counts references.
    """

    def register(helper: F) -> F:
        kernel_cache.register_helper(helper)
        inline = "always" if early else "never"
        return register_jitable(error_model="numpy", nogil=True, inline=inline)(helper)

    return register if function is None else register(function)


def load_builtins() -> None:
    """Load what compiled functions may call, which otherwise the first call of one of them does; it takes a third of a second."""
    cpu_target.typing_context.refresh()
    cpu_target.target_context.refresh()


def as_numpy_scalar(value: T) -> T:
    """Return `value` as a numpy scalar, because numba compiles a function again for every Python constant in a call."""
    return cast(T, np.asarray(value)[()])
