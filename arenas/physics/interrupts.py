"""Ctrl-C during a call of a compiled program whose callbacks run Python, such as the steps of MuJoCo's C engine."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

Args = ParamSpec("Args")
Result = TypeVar("Result")


@contextmanager
def keyboard_interrupts() -> Iterator[None]:
    """Raise KeyboardInterrupt where JAX reports it as an error of its own.

    Python runs a signal's handler in the main thread. If that thread is in a callback of a program, JAX catches the
    KeyboardInterrupt, and raises JaxRuntimeError with its traceback as text (jax 0.10 and 0.11).
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if is_interrupt(error):
            raise KeyboardInterrupt from None
        raise


def interruptible(program: Callable[Args, Result]) -> Callable[Args, Result]:
    """Return a program that raises KeyboardInterrupt when Ctrl-C stops one of its callbacks."""

    @wraps(program)
    def called(*args: Args.args, **kwargs: Args.kwargs) -> Result:
        with keyboard_interrupts():
            return program(*args, **kwargs)

    return called


def is_interrupt(error: Exception) -> bool:
    """Return whether a callback of the program was stopped by Ctrl-C: the last line of its traceback says so."""
    return str(error).rstrip(": \n").endswith("KeyboardInterrupt")
