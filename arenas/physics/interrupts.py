"""Ctrl-C during a call of a compiled program whose callbacks run Python, such as the steps of MuJoCo's C engine."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

Args = ParamSpec("Args")
Result = TypeVar("Result")


def interruptible(program: Callable[Args, Result]) -> Callable[Args, Result]:
    """Return the program, which raises KeyboardInterrupt when Ctrl-C stops one of its callbacks.

    Python runs a signal's handler in the main thread. If that thread is in a callback of a program, JAX catches the
    KeyboardInterrupt, and raises JaxRuntimeError with its traceback as text (jax 0.10.2).
    """

    @wraps(program)
    def called(*args: Args.args, **kwargs: Args.kwargs) -> Result:
        try:
            return program(*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            if is_interrupt(error):
                raise KeyboardInterrupt from None
            raise

    return called


def is_interrupt(error: Exception) -> bool:
    """Return whether Ctrl-C stopped a callback: the last line of the traceback in a JaxRuntimeError says so."""
    return str(error).rstrip(": \n").endswith("KeyboardInterrupt")
