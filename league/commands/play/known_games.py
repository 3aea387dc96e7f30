"""`league exploitability`: the exact exploitability of a policy in a small game."""

import json
from dataclasses import dataclass, field
from typing import Literal

from league.commands.options import Where, parse, positional
from league.matches.exact_exploitability import UNIFORM, KnownGame
from matchmaking.extensive_games.best_response import Exploitability

WHAT = """Compute the exact exploitability of a policy in a small game of turns: what best responses to it gain.
NashConv is the sum over both seats, exploitability the half of it; both are 0 for a Nash equilibrium. A policy plays
both seats. `league exploit` gives a lower bound in games of any size."""


@dataclass(frozen=True, kw_only=True)
class ExploitabilityOptions(Where):
    """The game and the policy."""

    game: str = positional()
    """The game: kuhn-poker, leduc-poker or dark-hex-3."""
    policy: str = field(default=UNIFORM)
    """The policy: uniform, for which no store is needed, or a snapshot such as blue@64, or a player, whose newest it
    is."""
    format: Literal["table", "json"] = "table"
    """Text for people, json for programs."""


def exploitability(args: list[str]) -> int:
    """Print the exploitability."""
    options = parse(ExploitabilityOptions, args, "exploitability", WHAT)
    game = KnownGame(options.game)
    if options.policy == UNIFORM:
        found = game.of_uniform()
    else:
        with options.open() as opened:
            found = game.of_snapshot(opened, options.policy)
    print(_json(options, found) if options.format == "json" else _text(options, found))
    return 0


def _json(options: ExploitabilityOptions, found: Exploitability) -> str:
    about = {"game": options.game, "policy": options.policy}
    return json.dumps(about | found._asdict(), indent=2)


def _text(options: ExploitabilityOptions, found: Exploitability) -> str:
    first, second = found.best_response_values
    return (
        f"Exploitability of {options.policy} in {options.game}: {found.exploitability:.6f} (NashConv"
        f" {found.nash_conv:.6f}).\nA best response in the first seat gains {first:+.6f}, in the second {second:+.6f}."
    )
