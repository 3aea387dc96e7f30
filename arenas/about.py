"""What an arena says about itself in words: what its numbers mean, what is rewarded, who plays. Loads nothing heavy.

Words stand beside what they describe (`Arena.observation_parts`, `Arena.legend`, `Robot.action_parts`, `outline` of
settings), and `league check` holds the two against each other: wrong sizes, names of terms or rosters fail it.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from arenas.options import Timing


class Part(NamedTuple):
    """Consecutive numbers of an observation, or of an action, that belong together."""

    name: str
    size: int
    unit: str = ""  # none: a share, a cosine, a choice, ...
    meaning: str = ""


@dataclass(frozen=True)
class Legend:
    """What a game's verdicts mean, in words: the names are those of the verdict. An empty one says nothing.

    A term without words is one whose weight is the setting `reward.NAME`: the note of that setting says what it is.
    """

    score: str = ""  # how a match is decided
    rewards: Mapping[str, str] = field(default_factory=dict)  # name -> when, and how much
    shapings: Mapping[str, str] = field(default_factory=dict)
    events: Mapping[str, str] = field(default_factory=dict)


class Seat(NamedTuple):
    """One robot of a roster."""

    kind: str
    sees: int  # numbers in its observation
    acts: int  # numbers in its action


@dataclass(frozen=True)
class Outline:
    """An arena in a line of a list, as its settings know it before anything is built."""

    what: str  # a few words
    teams: Mapping[str, tuple[Seat, ...]]
    timing: Timing
    page: str = ""  # docs/arenas/PAGE.md; several arenas may share one


def crowd(kinds: Iterable[str]) -> str:
    """A team in words, robots of one kind together, e.g. `2 × leatherback`."""
    counts = Counter(kinds)
    return " + ".join(f"{count} × {kind}" for kind, count in counts.items())


def numbers(parts: Iterable[Part]) -> int:
    """How many numbers the parts have together."""
    return sum(part.size for part in parts)


def indexed(parts: Iterable[Part]) -> Iterator[tuple[str, Part]]:
    """Each part with its place among the numbers, such as `3-5` or `6`."""
    first = 0
    for part in parts:
        yield (f"{first}-{first + part.size - 1}" if part.size > 1 else str(first)), part
        first += part.size
