"""Matches on the C engine between policies in files of several seeds, in a league that is removed afterwards.

A folder OUT has a folder for each seed, in which `PLAYER.safetensors` is the newest policy of a player, and
`PLAYER-0.safetensors`, where it is there, the initial one, as `league export` writes them and `experiments/trials.py`
leaves them. A player has the name of its team.
"""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from agents.rollout.rollout import PlayedEpisodes
from arenas.arena import Arena
from dashboards.system.temporary_folders import temporary_folder
from league.config import flags
from league.config.experiment import Config, change, default
from league.config.schema import ConfigError
from league.matches.evaluator import MatchEvaluator, Sides
from league.queries.query import Open
from league.runs.bench.metrics import cross_play
from league.runtime.bootstrap import create
from league.snapshots import policy_file
from league.snapshots.transfer.arena_transfer import elsewhere
from league.state.jobs import RatingMatch
from matchmaking.ratings.payoff import sum_matches
from scripts.record import make_parser
from storage.records import Match, Snapshot
from storage.store import Store

INITIAL, SUFFIX = "-0", ".safetensors"  # end the names of initial policies, and of files


class Batch(NamedTuple):
    """Games of a pair that were played at once."""

    match: Match
    games: PlayedEpisodes
    seats: Sequence[Sides]  # of each group of worlds
    seed: int


@dataclass(frozen=True)
class FileLeague:
    """A league in a temporary store whose snapshots are the policies of files, named SEED:PLAYER and SEED:PLAYER-0."""

    store: Store
    arena: Arena
    evaluator: MatchEvaluator
    snapshots: dict[str, Snapshot]

    def policies(self) -> dict[str, dict[str, Any]]:
        """Return what JSON has of each policy; `learnt elsewhere` marks those of other rules or bodies."""
        return {
            name: {"sha256": s.digest, "steps": s.step, "learnt elsewhere": elsewhere(s, self.arena)}
            for name, s in self.snapshots.items()
        }

    def batches(self, a: str, b: str, number: int) -> Iterator[Batch]:
        """Play a pair in so many batches, the second half of each with sides swapped where sides are alike."""
        first, second = self.snapshots[a], self.snapshots[b]
        seats = self.evaluator.side_orders(first, second)
        for k in range(number):
            task = RatingMatch(((a, b),), crc32(f"{a}/{b}/{k}".encode()))
            games = self.evaluator.games(self.store, seats, task.seed)
            yield Batch(self.evaluator.pair_match(games, 0, first, second, seats, task, None), games, seats, task.seed)


@contextmanager
def file_league(
    config: Config, folder: Path, seeds: Sequence[str], sides: Sequence[str], worlds: int
) -> Iterator[FileLeague]:
    """Yield the league of all seeds' policies, which plays and records `worlds` games at once.

    Raises StorageError, one line, for a file without a policy, or with one for other robots.
    """
    rating = replace(config.rating, worlds=worlds, pairings=1, record=True, trained=False, scripts=())
    config = replace(config, engine="c", rating=rating)
    arena = config.arena.build(engine="c", worlds=worlds)
    with temporary_folder("robot-league-policies-") as kept, Store.open(kept, create=True) as store:
        create(store, config, arena)
        opened, snapshots = Open(store, config.league), {}
        for seed in seeds:
            for name in (f"{side}{which}" for side in sides for which in ("", INITIAL)):
                file = folder / seed / f"{name}{SUFFIX}"
                if file.exists() or not name.endswith(INITIAL):
                    policy = policy_file.read(file)
                    snapshots[f"{seed}:{name}"] = policy_file.bring_in(opened, policy, f"{seed}:{name}")
        evaluator = MatchEvaluator(config, arena, config.league, tuple(range(worlds)))
        evaluator.make_room(store, list(snapshots.values()))
        yield FileLeague(store, arena, evaluator, snapshots)


def score_of(a: str, b: str, matches: Sequence[Match]) -> dict[str, Any]:
    """Return what JSON has of the score of a pair, seen from A, with its 95 % interval."""
    score = sum_matches(matches).score(a, b)
    interval = {"score": round(score.score, 4), "low": round(score.low, 4), "high": round(score.high, 4)}
    return {"a": a, "b": b, "score": interval, "games": score.games, "voids": score.voids}


def between_seeds(matches: Sequence[Match], seeds: Sequence[str], sides: Sequence[str]) -> dict[str, Any]:
    """Return scores of every seed's first side against every seed's second, and their difference off the diagonal and
    on it.

    Its 95 % interval is of these seeds' games, whose variances add up; it says nothing of further seeds.
    """
    payoff = sum_matches(matches)
    first, second = ([f"{seed}:{side}" for seed in seeds] for side in sides)
    found = cross_play(payoff, first, second)
    scores = [[payoff.score(a, b) for b in second] for a in first]
    halves = np.array([[(score.high - score.low) / 2 for score in row] for row in scores])
    table, own = np.array([[score.score for score in row] for row in scores]), np.eye(len(seeds), dtype=bool)
    half = np.sqrt(sum((halves[where] ** 2).sum() / where.sum() ** 2 for where in (own, ~own)))
    value = found["off_diagonal_less_diagonal"]
    means = {name: round(float(table[at].mean()), 4) for name, at in (("diagonal", own), ("off_diagonal", ~own))}
    return {**found, **means, "low": round(float(value - half), 4), "high": round(float(value + half), 4)}


def parser_of_pairs(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the arguments of scripts that play pairs of policies in files."""
    parser = make_parser(description)
    parser.add_argument("folder", type=Path, help="OUT, with a folder of policies for each seed")
    parser.add_argument("--seeds", nargs="+", help="names of those folders (default: all)")
    parser.add_argument("--episodes", type=int, default=256, help="games of each pair, a multiple of --worlds")
    parser.add_argument("--worlds", type=int, default=128, help="games at once, an even number")
    return parser


def config_of(parser: argparse.ArgumentParser, arena: str, further: Sequence[str]) -> Config:
    """Return the settings of a league in an arena with further flags of `league run`; end the program if they fail."""
    try:
        base = default(arena)
        return change(base, flags.split(further, lambda key: flags.is_switch(key, Config, base)).given)
    except ConfigError as error:
        parser.error(str(error))


def check_pairs(parser: argparse.ArgumentParser, args: argparse.Namespace, sides: Sequence[str]) -> None:
    """Fill in the seeds, and end the program with a line about arguments that do not fit."""
    found = sorted(path.parent.name for path in args.folder.glob(f"*/{sides[0]}{SUFFIX}"))
    args.seeds = args.seeds or found
    if not args.seeds:
        parser.error(f"{args.folder} has no folder with a {sides[0]}{SUFFIX}")
    if args.worlds < 2 or args.worlds % 2 or args.episodes < 1 or args.episodes % args.worlds:
        parser.error("--episodes must be a multiple of --worlds, and --worlds even")
