"""`league sprt`: the sequential test of `league gate` for counts given by the user."""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

from dashboards.tables import Column, render
from league.commands.options import HypothesesOptions, parse
from league.config.schema import ConfigError

COLUMNS = (
    "pairs", Column("llr", "LLR", 3), Column("lower", decimals=3), Column("upper", decimals=3),
    Column("decision", no_wrap=True), Column("elo", "Elo", 1), Column("low", "from", 1), Column("high", "to", 1),
)  # fmt: skip
_COUNT = re.compile(r"-?[\d.,]+")


@dataclass(frozen=True, kw_only=True)
class SprtOptions(HypothesesOptions):
    """The counts, and the test."""

    pentanomial: tuple[int, ...] = field(default=(), metadata={"low": 0})
    """Numbers of seed pairs that scored 0, ½, 1, 1½ and 2 for A: LL LD DD DW WW, five numbers."""
    format: Literal["table", "json"] = "table"
    """table for people, json for programs."""

    def __post_init__(self) -> None:
        """Refuse anything but five counts."""
        super().__post_init__()
        if self.pentanomial and len(self.pentanomial) != 5:
            raise ValueError(f"pentanomial: must be five counts, LL LD DD DW WW, not {len(self.pentanomial)}")


def sprt(args: list[str]) -> int:
    """Print the state of a test."""
    what = "A sequential probability ratio test on seed pairs: accept that A is better, reject it, or continue."
    options = parse(SprtOptions, _listed(args), "sprt", what)
    if not options.pentanomial:
        raise ConfigError((), "league sprt needs --pentanomial LL,LD,DD,DW,WW, five counts: see league sprt --help")
    found = options.test().result(options.pentanomial)
    if options.format == "json":
        print(json.dumps(found.for_json(), indent=2))
    else:
        print(render([{"pairs": sum(options.pentanomial), **found.for_json()}], COLUMNS))
    return 0


def _listed(args: Sequence[str]) -> list[str]:
    """Return the arguments with the numbers after --pentanomial, which are typed as words, as one list."""
    left, found = list(args), []
    while left:
        found.append(left.pop(0))
        if found[-1] == "--pentanomial":
            counts = []
            while left and _COUNT.fullmatch(left[0]):
                counts.append(left.pop(0))
            found += [",".join(counts)] if counts else []
    return found
