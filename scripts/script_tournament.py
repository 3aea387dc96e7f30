"""Table of the scores of all scripts of an arena against each other, for its page.

    python -m scripts.script_tournament sumo-1v1                         # prints the table
    python -m scripts.script_tournament sumo-1v1 --episodes 500 --page   # and writes it into the arena's page
    python -m scripts.script_tournament sumo-1v1 --pairs pusher:idle     # only these, with the seeds of the table

Episodes are played and counted as in a league's rating matches (`league/matches/evaluator.py`), with seed pairs, and
with sides swapped if rosters are equal, in a store that is deleted afterwards. In an arena of three and more equal
teams one team plays a script against all others with another one, in all rotations of seats from the same seeds. A page
has the table between two marks, as the part of `scripts/arena_pages.py`; each arena has its own marks, at any place of
the page.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
from pathlib import Path
from typing import get_args

import arenas
from arenas.arena import Arena, Settings
from arenas.arena_settings import EngineName
from arenas.errors import ArenaError
from dashboards.system.temporary_folders import temporary_folder
from league.commands.cli import guarded
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.sections import Rating
from league.matches.evaluator import MatchEvaluator
from league.queries import arena_info
from league.snapshots.codec import add_scripts
from league.state.jobs import RatingMatch
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.payoff import sum_matches
from matchmaking.ratings.scores import Score
from scripts import arena_pages
from storage.records import ArenaKey, League, Match, RankedMatch
from storage.store import Store

LEAGUE = "tournament"
EPISODES = 500


@dataclass(frozen=True)
class Tournament:
    """A tournament's players and results; `sides` has the names of each team's snapshots by script."""

    key: ArenaKey
    teams: tuple[str, ...]
    sides: tuple[dict[str, str], ...]  # script -> snapshot, of each team; equal where rosters are
    episodes: int  # for each pair, void ones included
    ladder: Ladder
    one_against_all: dict[tuple[str, str], Score]  # (snapshot, the others') -> its score, of three and more teams

    @property
    def alike(self) -> bool:
        """True if all teams have the same roster."""
        return len(self.sides) > 1 and all(side == self.sides[0] for side in self.sides)


def pairs(sides: Sequence[dict[str, str]]) -> list[tuple[str, str | None]]:
    """Return all pairs of scripts: of equal teams each pair once, else each of one side with each of the other.

    In an arena of one team the opponent is None. Of three and more teams the first script is one team's, the second
    that of all others. Raises ArenaError for three and more unlike teams, or a team without scripts.
    """
    if not all(sides):
        raise ArenaError("a table of scripts needs one that a whole team can play, for each of the teams")
    if len(sides) > 2:
        if any(side != sides[0] for side in sides):
            raise ArenaError(f"a table of scripts is for one team, two, or equal ones, and here are {len(sides)}")
        return [*permutations(sides[0].values(), 2)]
    if len(sides) == 1:
        return [(name, None) for name in sides[0].values()]
    first, second = (side.values() for side in sides)
    return [*combinations(first, 2)] if sides[0] == sides[1] else [*product(first, second)]


def chosen(sides: Sequence[dict[str, str]], asked: Sequence[str]) -> set[tuple[str, str | None]]:
    """Return the `pairs` named "a:b", in either order if rosters are equal, or "a" in an arena of one team.

    Raises ArenaError for a name that is no pair, with the possible names.
    """
    scripts = [{name: script for script, name in side.items()} for side in sides]
    known = {":".join(of[x] for of, x in zip(scripts, pair, strict=False) if x): pair for pair in pairs(sides)}
    alike = len(sides) == 2 and sides[0] == sides[1]
    named = known | {":".join(reversed(name.split(":"))): pair for name, pair in known.items()} if alike else known
    if unknown := [name for name in asked if name not in named]:
        raise ArenaError(f"--pairs {' '.join(unknown)}: here there are {', '.join(known)}")
    return {named[name] for name in asked}


def play(
    arena: Arena, settings: Settings, episodes: int = EPISODES, seed: int = 1, asked: Sequence[str] = ()
) -> Tournament:
    """Play `episodes` of each pair, an even number, with a seed for each pair; print each pair to stderr.

    `asked` names the pairs to play, see `chosen`; empty: all. The seed of a pair does not depend on it.
    """
    config = Config(arena=settings, rating=Rating(worlds=episodes, pairings=1, record=False))
    evaluator = MatchEvaluator(config, arena, LEAGUE)
    with temporary_folder("robot-league-tournament-") as folder, Store.open(folder, create=True) as store:
        store.create_league(League(LEAGUE, configuration.dumps(config)))
        add_scripts(store, LEAGUE, arena, None)
        known = {(s.roster, s.script): s.name for s in store.snapshots(LEAGUE)}
        sides = tuple(
            {script: known[team.roster, script] for script in arena.playable_scripts(team)} for team in arena.teams
        )
        matches: list[Match] = []
        scores: dict[tuple[str, str], Score] = {}
        wanted = chosen(sides, asked) if asked else set(pairs(sides))
        for number, (a, b) in enumerate(pairs(sides)):
            if (a, b) not in wanted:
                continue
            print(f"{arena.name}: {a}{f' against {b}' if b else ''}", file=sys.stderr)
            others = [b] * max(1, len(sides) - 1)
            found = evaluator.play(store, RatingMatch(((a, *others),), seed + number, record=False))
            if b is not None and len(others) > 1:
                scores[a, b] = alone(a, [match for match in found if isinstance(match, RankedMatch)])
            else:
                matches += [match for match in found if isinstance(match, Match)]
    ladder = Ladder([name for side in sides for name in side.values()], matches)
    return Tournament(evaluator.key, tuple(team.name for team in arena.teams), sides, episodes, ladder, scores)


def alone(name: str, matches: Sequence[RankedMatch]) -> Score:
    """Return a snapshot's score in the rotations of a lineup in which it plays one team, and its 95 % interval.

    Its score in a game is that against each other team, on average: 1 if it is ahead of all, ½ if all are equal.
    `games` are episodes.
    """
    payoff = sum_matches(matches)
    found = payoff.score(name, *(other for other in payoff.names if other != name))
    voids = sum(match.voids for match in matches)
    return found._replace(games=sum(match.episodes for match in matches), voids=voids)


def markdown(played: Tournament) -> str:
    """Format the tournament in Markdown: a sentence and the table."""
    return f"{_sentence(played)}\n\n{arena_pages.table(_rows(played), _columns(played))}"


def _sentence(played: Tournament) -> str:
    of = f"on engine `{played.key.engine}` (rules {played.key.config_hash[:8]})"
    if len(played.sides) == 1:
        return (
            f"Success of the scripts in `{played.key.arena}`, with its 95 % interval: {played.episodes} episodes {of}."
        )
    if len(played.sides) > 2:
        return (
            f"Score of one team with the row's script against {len(played.sides) - 1} with the column's in"
            f" `{played.key.arena}`, on average over these: ½ is even, and a tie counts half. With its 95 % interval:"
            f" {played.episodes} episodes of each pair {of}, in all rotations of seats from the same seeds."
        )
    whose = "the row's script against the column's"
    how = "seed pairs with sides swapped"
    if not played.alike:
        whose = f"{played.teams[0]} (rows) against {played.teams[1]} (columns)"
        how = "sides as they are, for the teams are unlike"
    return (
        f"Score of {whose} in `{played.key.arena}`, a draw counts half, with its 95 % interval: {played.episodes}"
        f" episodes of each pair {of}, {how}."
    )


def _columns(played: Tournament) -> list[str]:
    return ["", *(["success"] if len(played.sides) == 1 else played.sides[1])]


def _rows(played: Tournament) -> Iterator[dict[str, object]]:
    for script, a in played.sides[0].items():
        row: dict[str, object] = {"": script}
        if len(played.sides) == 1:
            row["success"] = _cell(played, a, None)
        else:
            row |= {other: _cell(played, a, b) for other, b in played.sides[1].items()}
        yield row


def _cell(played: Tournament, a: str, b: str | None) -> str:
    """Format a score with its interval, and the numbers of drawn and void episodes unless zero."""
    ladder = played.ladder
    if a == b:
        return "–"
    payoff, i = ladder.payoff, ladder.payoff.index(a)
    if b is not None and len(played.sides) > 2:
        score = played.one_against_all.get((a, b), Score(float("nan"), 0.0, 1.0, 0))
        draws, voids = 0, score.voids
    elif b is None:
        score, draws, voids = ladder.success(a), 0, int(payoff.trials[i, 2])
    else:
        j = payoff.index(b)
        score, draws, voids = ladder.score(a, b), payoff.draws[i, j], (payoff.episodes - payoff.games)[i, j]
    counts = [f"{n} {what}" for n, what in ((draws, "drawn"), (voids, "void")) if n]
    if not score.games:
        return ", ".join(counts)
    return ", ".join([f"{100 * score.score:.1f} % ({100 * score.low:.1f}-{100 * score.high:.1f})", *counts])


def begin(name: str) -> str:
    """Return the mark before an arena's table on its page; the table ends at `arena_pages.END`."""
    return f"<!-- played by the scripts of {name}: python -m scripts.script_tournament {name} --page -->"


def write(name: str, text: str) -> Path:
    """Write the table into the arena's page. Raises ArenaError without a page, ValueError without marks in it."""
    page = arena_info.outline(arenas.settings(name)).page
    if not page:
        raise ArenaError(f"arena {name} has no page to write into")
    file = arena_pages.ROOT / f"docs/arenas/{page}.md"
    file.write_text(arena_pages.replaced(file.read_text("utf-8"), begin(name), text), "utf-8")
    return file


def main(argv: Sequence[str] | None = None) -> int:
    """Play the named arenas; print each table, and with --page write it."""
    asked = argparse.ArgumentParser(description="All scripts of an arena against all.")
    asked.add_argument("names", nargs="+", metavar="NAME", help="arenas, or file.py:name for your own")
    asked.add_argument("--episodes", type=int, default=EPISODES, help=f"of each pair, an even number ({EPISODES})")
    asked.add_argument("--engine", choices=get_args(EngineName), default="c", help="physics (c)")
    asked.add_argument("--seed", type=int, default=1)
    asked.add_argument("--pairs", nargs="+", default=(), metavar="A:B", help="play only these (all)")
    asked.add_argument("--page", action="store_true", help="write the table into the arena's page")
    options = asked.parse_args(argv)
    if options.pairs and options.page:
        asked.error("--pairs: a page has the table of all pairs; leave out --pairs or --page")
    if options.episodes < 2 or options.episodes % 2:
        asked.error(f"--episodes {options.episodes}: must be even and 2 or more, half of them with sides swapped")
    for name in options.names:
        settings = arenas.settings(name)
        arena = settings.build(engine=options.engine, worlds=options.episodes)
        each = math.lcm(2, len(arena.teams))  # as many episodes in each rotation, and an even number of worlds
        episodes = -(-options.episodes // each) * each
        text = markdown(play(arena, settings, episodes, options.seed, options.pairs))
        print(text)
        if options.page:
            print(write(name, text))
    return 0


if __name__ == "__main__":
    sys.exit(guarded(main))
