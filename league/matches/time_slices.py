"""Batches of matches played in time slices: training has the GPU in between, and a batch ends with its last episode."""

import jax
import numpy as np

from agents.policy.jax_policy import PolicyStack
from agents.rollout.rollout import EpisodeRecords, PlayedEpisodes, finish_match, make_stepwise_play
from arenas.arena import Arena
from league.system.compiled import Compiled
from league.system.devices import used
from league.system.gpu_sharing import GpuLock, Pace

CONTROL_STEPS = 16
"""Control steps of a time slice: a fraction of a second of GPU time."""


class TimeSlices:
    """A compiled match of an arena, played `length` decisions at a time, at the times that `pace` and `lock` allow."""

    def __init__(self, arena: Arena, recorded: tuple[int, ...], pace: Pace, lock: GpuLock, length: int | None = None):
        self.pace, self.lock = pace, lock
        self.length = length or max(1, CONTROL_STEPS // arena.timing.hold)
        begin, go_on = make_stepwise_play(arena, self.length, recorded)
        self._begin, self._go_on = Compiled(begin, arena), Compiled(go_on, arena)

    def compile(self, stacks: dict[str, PolicyStack], keys: jax.Array) -> None:
        """Compile both programs for arguments of these shapes; run the first, whose result is the second's argument."""
        begin = self._begin.ready(stacks, keys)
        with self.lock.playing():
            match_state = jax.block_until_ready(begin(stacks, keys))
        self._go_on.ready(stacks, match_state)

    def play(self, stacks: dict[str, PolicyStack], keys: jax.Array) -> tuple[PlayedEpisodes, float]:
        """Play a batch; return the games on the host, and their device seconds without pauses and compilation.

        The batch ends with the time slice in which its last episode ends.
        """
        begin = self._begin.ready(stacks, keys)
        began = used(jax.default_backend())
        match_state = jax.block_until_ready(begin(stacks, keys))
        seconds, over, records = used(jax.default_backend()) - began, False, []
        self.pace.took(seconds)
        go_on = self._go_on.ready(stacks, match_state)
        while not over:
            self.pace.wait()
            with self.lock.playing():
                more = True
                while more and not over:
                    began = used(jax.default_backend())
                    match_state, *news = go_on(stacks, match_state)
                    seen, over = jax.device_get(news)
                    records.append(seen)
                    del news  # frees memory that the next time slice uses, at the same place
                    took = used(jax.default_backend()) - began
                    seconds, more = seconds + took, self.pace.took(took)
        return jax.device_get(finish_match(match_state, _joined(records))), seconds


def _joined(records: list[EpisodeRecords]) -> EpisodeRecords:
    """Concatenate the frames of all time slices along time."""
    return jax.tree.map(lambda *parts: np.concatenate(parts), *records)
