"""What every arena can be told, and what its settings look like. Loads nothing heavy: settings are read without jax."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypedDict, Unpack

if TYPE_CHECKING:
    from arenas.arena import Arena

EngineName = Literal["auto", "c", "jax", "warp"]


@dataclass(frozen=True)
class Timing:
    """Seconds and counts: physics timestep, timesteps per control step, control steps per decision, episode length."""

    timestep: float = 0.005
    substeps: int = 4
    hold: int = 1
    episode: float = 30.0

    @property
    def control_interval(self) -> float:
        """Seconds between two judgements of the game, and between two frames of a recording."""
        return self.timestep * self.substeps

    @property
    def decision_interval(self) -> float:
        """Seconds for which an action is held."""
        return self.control_interval * self.hold

    @property
    def decisions(self) -> int:
        """The most decisions an episode can take."""
        return math.ceil(self.episode / self.decision_interval - 1e-9)


@dataclass(frozen=True)
class Solver:
    """How an arena's contacts are solved, and Warp's buffers for them.

    Newton leaves its loop when it has converged, so a cap costs little; one that is reached costs much, because the
    implicit integrator moves bodies by forces that do not balance yet. How far one control step then ends from where a
    converged solve ends, the farthest base of any robot, 99.99th percentile of scripted play of two ANYmals and two
    rovers (8,192 control steps, C engine, all robots solved as one; `benchmarks/results/arenas-cpu.json`): with 20
    iterations of 4 line-search steps 1 µm (four ANYmals 0.09 mm), 16 of 4 4 µm, but once 15 mm, 14 of 4 3 mm, 10 of 20
    14 mm, 8 of 10 66 mm, 4 of 10 1.4 m. The mean is 5 iterations, the most 18. Longer line searches need more, not
    fewer; rovers alone need 14.

    Buffers are per world: what does not fit makes the world void, so size them from trained play and not from the first
    random steps.
    """

    iterations: int = 20
    ls_iterations: int = 4
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    impratio: float = 1.0  # friction against normal stiffness; more slips less and needs more iterations
    contacts: int = 24  # Warp's contact slots per world
    rows: int = 128  # Warp's constraint rows per world


class Where(TypedDict, total=False):
    """Where an arena runs: an engine's name, the most worlds stepped together, threads of the C engine (0: all)."""

    engine: EngineName
    worlds: int
    threads: int


class Settings(Protocol):
    """An arena's settings: a frozen dataclass of plain values that can build it.

    By convention what decides a game stands in a field `rules`, a frozen dataclass too: the contract's examination then
    sees that each of its fields changes the configuration hash.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """The arena's name, e.g. `sumo-2v2`."""
        ...

    def build(self, **where: Unpack[Where]) -> "Arena":
        """The arena itself."""
        ...
