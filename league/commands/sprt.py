"""`league sprt`: the sequential test of `league gate` for counts that somebody brings."""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from dashboards.tables import Column, render
from league.commands.options import parse
from matchmaking.sprt import Result, Sequential

COLUMNS = (
    "pairs", Column("llr", "LLR", 3), Column("lower", decimals=3), Column("upper", decimals=3),
    Column("decision", whole=True), Column("elo", "Elo", 1), Column("low", "from", 1), Column("high", "to", 1),
)  # fmt: skip
_COUNT = re.compile(r"-?[\d.,]+")


@dataclass(frozen=True, kw_only=True)
class HypothesesOptions:
    """A test of two hypotheses: elo0, and elo1 above it."""

    elo0: float = 0.0
    """The Elo difference by which A is not better."""
    elo1: float = 20.0
    """The one by which it is."""
    alpha: float = field(default=0.05, metadata={"above": 0.0, "below": 1.0})
    """How often to accept, at most, where elo0 is true."""
    beta: float = field(default=0.05, metadata={"above": 0.0, "below": 1.0})
    """How often to reject, at most, where elo1 is true."""
    model: Literal["logistic", "normalized"] = "logistic"
    """What elo0 and elo1 are: logistic Elo, or Elo normalised by the spread of a game's score."""

    def __post_init__(self) -> None:
        """Refuse a test that cannot decide anything."""
        self.test()

    def test(self) -> Sequential:
        """The test."""
        return Sequential(self.elo0, self.elo1, self.alpha, self.beta, self.model)


@dataclass(frozen=True, kw_only=True)
class SprtOptions(HypothesesOptions):
    """What was counted, and the test."""

    pentanomial: tuple[int, ...] = field(default=(), metadata={"low": 0})
    """How many seed pairs scored 0, ½, 1, 1½ and 2 for A: LL LD DD DW WW, five numbers."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""

    def __post_init__(self) -> None:
        """Refuse anything but five counts."""
        super().__post_init__()
        if len(self.pentanomial) != 5:
            raise ValueError(f"pentanomial: must be five counts, LL LD DD DW WW, not {len(self.pentanomial)}")


def sprt(args: list[str]) -> int:
    """Print how a test stands."""
    what = "A sequential probability ratio test on seed pairs: accept that A is better, reject it, or continue."
    options = parse(SprtOptions, _listed(args), "sprt", what)
    found = options.test().result(options.pentanomial)
    if options.format == "json":
        print(json.dumps(row(found), indent=2))
    else:
        print(render([{"pairs": sum(options.pentanomial), **row(found)}], COLUMNS))
    return 0


def row(found: Result) -> dict[str, float | str | None]:
    """A result as JSON has it: null where the counts say nothing, or the difference is without bound."""
    return {
        name: each if isinstance(each, str) or math.isfinite(each) else None for name, each in found._asdict().items()
    }


def _listed(args: Sequence[str]) -> list[str]:
    """The arguments with the numbers after --pentanomial, which people type as words, as one list."""
    words, found = list(args), []
    while words:
        found.append(words.pop(0))
        if found[-1] == "--pentanomial":
            counts = []
            while words and _COUNT.fullmatch(words[0]):
                counts.append(words.pop(0))
            found += [",".join(counts)] if counts else []
    return found
