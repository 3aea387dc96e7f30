"""Descriptions of arenas: the meaning of numbers, the rewards, the teams. Loads nothing heavy.

Each description stands beside its subject (`Arena.observation_parts`, `Arena.legend`, `Robot.action_parts`, `outline`
of settings). `league check` compares both: wrong sizes, wrong names of terms and wrong rosters fail it.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from arenas.arena_settings import Timing


class Part(NamedTuple):
    """Consecutive numbers of an observation or action that belong together."""

    name: str
    size: int
    unit: str = ""  # empty: a share, a cosine, a choice, ...
    meaning: str = ""
    opponent: bool = False  # the numbers are about the other team: `league exploit --mask-opponent` freezes them


class Entities(NamedTuple):
    """A set of like things in an observation, whose order has no meaning: others, obstacles, ...

    An entity that is not there has zeros in all its places.
    """

    name: str
    places: tuple[tuple[int, ...], ...]  # for each entity those of its numbers, alike in meaning and order


def entity_places(first: int, count: int, size: int) -> tuple[tuple[int, ...], ...]:
    """Return the places of `count` entities of `size` numbers each, one after the other from `first` on."""
    return tuple(tuple(range(first + i * size, first + (i + 1) * size)) for i in range(count))


Place = tuple[str, int, int]
"""A part among others: its name, its size, and how many of that name and size come before it."""


def first_numbers(parts: Iterable[Part]) -> dict[Place, int]:
    """Return the index of the first number of each part, in the order of the parts."""
    found: dict[Place, int] = {}
    first, met = 0, Counter[tuple[str, int]]()
    for part in parts:
        found[part.name, part.size, met[part.name, part.size]] = first
        met[part.name, part.size] += 1
        first += part.size
    return found


EVENT_METRIC = "event."
"""Prefix of an event's name in that of its learning curve, the share of episodes in which it happened."""


@dataclass(frozen=True)
class Legend:
    """Description of a game's verdicts, by the names that the verdict uses. An empty legend describes nothing.

    A term with an empty description has the setting `reward.NAME` as its weight, and that setting's note describes it.
    """

    score: str = ""  # how a match is decided
    rewards: Mapping[str, str] = field(default_factory=dict)  # name -> condition and amount
    shapings: Mapping[str, str] = field(default_factory=dict)
    events: Mapping[str, str] = field(default_factory=dict)


class AgentOutline(NamedTuple):
    """One agent in an outline: its kind and sizes."""

    kind: str
    observation_size: int  # numbers in its observation
    action_size: int  # numbers in its action


Seat = AgentOutline  # former name, kept for one release


@dataclass(frozen=True)
class Outline:
    """Summary of an arena for lists, known from its settings without building it."""

    what: str  # a few words
    teams: Mapping[str, tuple[AgentOutline, ...]]
    timing: Timing
    page: str = ""  # docs/arenas/PAGE.md; several arenas may share one


def describe_team(kinds: Iterable[str]) -> str:
    """Describe a team briefly, with robots of one kind together, e.g. `2 × leatherback`."""
    counts = Counter(kinds)
    return " + ".join(f"{count} × {kind}" for kind, count in counts.items())


def total_size(parts: Iterable[Part]) -> int:
    """Count the numbers of all parts together."""
    return sum(part.size for part in parts)


def with_indices(parts: Iterable[Part]) -> Iterator[tuple[str, Part]]:
    """Yield each part with its indices, such as `3-5` or `6`."""
    first = 0
    for part in parts:
        yield (f"{first}-{first + part.size - 1}" if part.size > 1 else str(first)), part
        first += part.size
