"""Options common to all arenas, and the protocol of their settings. Light: settings are read without jax."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypedDict

EngineName = Literal["auto", "c", "jax", "warp"]


class Table(Mapping[str, Any]):
    """A setting that is a table of any keys, with plain values: texts, numbers, switches, lists, and tables of those.

    It does not change, and can be hashed. Raises ValueError, one line, for a value of another kind.
    """

    def __init__(self, values: Mapping[str, Any] = {}):
        self._values = {str(name): _plain(value, str(name)) for name, value in values.items()}

    def __getitem__(self, name: str) -> Any:
        """Return the value of a key."""
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        """Iterate over the keys in their order."""
        return iter(self._values)

    def __len__(self) -> int:
        """Return the number of keys."""
        return len(self._values)

    def __hash__(self) -> int:
        """Return the hash of the keys and values, whatever their order."""
        return hash(frozenset(self._values.items()))

    def __repr__(self) -> str:
        """Write the table as a dictionary."""
        return repr(self._values)


def _plain(value: Any, name: str) -> Any:
    """Return a plain value in a form that cannot change."""
    if isinstance(value, Mapping):
        return Table(value)
    if isinstance(value, list | tuple):
        return tuple(_plain(each, name) for each in value)
    if not isinstance(value, str | bool | int | float) or (isinstance(value, float) and not math.isfinite(value)):
        raise ValueError(f"{name}: {value!r:.80} is no text, finite number, switch, list or table")
    return value


@dataclass(frozen=True)
class Timing:
    """Durations in seconds and counts: physics timestep, timesteps per control step, control steps per decision,
    episode.
    """

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
        """The maximum number of decisions in an episode."""
        return math.ceil(self.episode / self.decision_interval - 1e-9)


@dataclass(frozen=True)
class Solver:
    """Solver options for an arena's contacts, and the sizes of Warp's buffers.

    Newton's method stops when it has converged, so a high cap costs little. Reaching the cap costs accuracy, because
    the implicit integrator then moves bodies by forces that are not yet balanced. Measured error: the distance between
    the end of one control step and that of a converged solve, for the farthest base of any robot, as the 99.99th
    percentile of scripted play of two ANYmals and two rovers (8,192 control steps, C engine, all robots solved as one;
    `benchmarks/results/arenas-cpu.json`). With 20 iterations of 4 line-search steps it is 1 µm (four ANYmals 0.09 mm),
    16 of 4 give 4 µm, but once 15 mm, 14 of 4 3 mm, 10 of 20 14 mm, 8 of 10 66 mm, 4 of 10 1.4 m. The mean is 5
    iterations, the maximum 18. Longer line searches need more iterations, not fewer; rovers alone need 14.

    Warp's buffers: all worlds share one pool of contacts, whose size limits both the pairs of geoms that are near each
    other and the contacts between them. Each world has constraint rows of its own. An overflow makes worlds void, all
    of them if the pool is full. Untrained robots need more than trained ones: they lie down, and many of their geoms
    are near each other. `benchmarks/buffers.py` measures the needs of an arena.
    """

    iterations: int = 20
    ls_iterations: int = 4
    cone: Literal["pyramidal", "elliptic"] = "pyramidal"
    impratio: float = 1.0  # friction against normal stiffness; a higher ratio slips less and needs more iterations
    contacts: int = 24  # Warp's contact slots per world, for many worlds
    rows: int = 128  # Warp's constraint rows per world
    spare: int | None = None  # additional slots, times the square root of the number of worlds; None: as `contacts`

    def slots(self, worlds: int) -> int:
        """Return the contact slots that so many worlds share.

        Worlds differ in their needs. If `contacts` covers the mean, the sum over n independent worlds exceeds n ×
        `contacts` by a multiple of their standard deviation times √n (the central limit theorem), which `spare` covers.
        Few worlds therefore need more slots per world than many.
        """
        spare = self.contacts if self.spare is None else self.spare
        return self.contacts * worlds + math.ceil(spare * math.sqrt(worlds))

    def with_buffers(self, contacts: int | None = None, rows: int | None = None) -> "Solver":
        """Return the same solver with other buffers where these are given."""
        return replace(self, contacts=contacts or self.contacts, rows=rows or self.rows)


class BufferSizes(TypedDict, total=False):
    """Sizes of Warp's buffers that replace an arena's own, as in `Solver`."""

    contacts: int
    rows: int


class EngineOptions(BufferSizes, total=False):
    """Options for running an arena: engine name, maximum number of worlds stepped together, threads of the C engine (0:
    all).
    """

    engine: EngineName
    worlds: int
    threads: int


Where = EngineOptions  # former name, kept for one release
