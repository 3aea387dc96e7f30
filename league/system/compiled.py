"""Programs that are compiled before they run, so that no timing includes compilation."""

from collections.abc import Callable
from typing import Any

import jax

from arenas.arena import Arena
from arenas.physics.interrupts import interruptible
from league.system.memory import of_program


class Compiled:
    """A jitted program of an arena, compiled once for every shape of its arguments."""

    def __init__(self, program: jax.stages.Wrapped, arena: Arena):
        self._program = program
        self._engine = arena.engine
        self._loads_late = arena.engine.name == "warp"  # Warp captures its kernels in graphs at their first run
        self._ready: dict[object, Callable[..., Any]] = {}
        self.bytes = 0  # memory of the program that was compiled last

    def compile(self, *args: Any) -> None:
        """Compile the program for arguments of these shapes, for XLA's cache alone."""
        self._program.lower(*args).compile()

    def ready(self, *args: Any) -> Callable[..., Any]:
        """Return the program for arguments of these shapes, all arrays; compile it now if it is not compiled yet.

        The program raises KeyboardInterrupt if Ctrl-C stops the engine's steps.
        """
        leaves, structure = jax.tree.flatten(args)
        shape = structure, tuple((x.shape, x.dtype) for x in leaves)
        if shape not in self._ready:
            lowered = self._program.lower(*args)
            # Load only while XLA compiles: Warp may lose its current stream if threads load kernels during a call.
            kernels_loaded = self._engine.prepare()
            compiled = lowered.compile()
            kernels_loaded()
            self.bytes = of_program(compiled)
            self._ready[shape] = interruptible(compiled)
            if self._loads_late:
                copies = jax.tree.map(lambda x: x.copy(), args)  # a run may donate its arguments
                jax.block_until_ready(self._ready[shape](*copies))
        return self._ready[shape]
