"""Programs that are compiled before they run, so that no clock takes compiling for work."""

from collections.abc import Callable
from typing import Any

import jax

from arenas.arena import Arena
from league.memory import of_program


class Compiled:
    """A jitted program of an arena, compiled once for every shape of its arguments."""

    def __init__(self, program: jax.stages.Wrapped, arena: Arena):
        self._program = program
        self._engine = arena.engine
        self._loads_late = arena.engine.name == "warp"  # its kernels are put into graphs when they first run
        self._ready: dict[object, Callable[..., Any]] = {}
        self.bytes = 0  # that the program takes which was compiled last

    def ready(self, *args: Any) -> Callable[..., Any]:
        """The program for arguments of these shapes, all of them arrays; what is still to be compiled is, now."""
        leaves, structure = jax.tree.flatten(args)
        shape = structure, tuple((x.shape, x.dtype) for x in leaves)
        if shape not in self._ready:
            lowered = self._program.lower(*args)
            # Only while XLA compiles: where threads load kernels while Warp is called, it may lose the stream it is on.
            kernels_loaded = self._engine.prepare()
            compiled = self._ready[shape] = lowered.compile()
            kernels_loaded()
            self.bytes = of_program(compiled)
            if self._loads_late:
                copies = jax.tree.map(lambda x: x.copy(), args)  # a run may use its arguments up
                jax.block_until_ready(self._ready[shape](*copies))
        return self._ready[shape]
