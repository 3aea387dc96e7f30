"""Cross-play of seeds in an arena of two teams: scores against first opponents, and against those of every seed.

    python -m experiments.cross_play OUT --arena sumo-by-team --out experiments/results/cross-play-by-team-h200.json
    python -m experiments.cross_play OUT --arena galaga-1v1 --episodes 512 -- --arena.rich=true --arena.buffer=8

OUT has a folder for each seed, see `experiments/policy_files.py`; arguments after `--` are further settings of the
arena, as flags of `league run`. On the C engine, on a host with a GPU best with JAX_PLATFORMS=cpu, these pairs play
`--episodes` games each:

- of each seed, each side's newest policy against the other side's initial one, and initial against initial, where OUT
  has initial ones;
- the newest policy of the first side of each seed against the newest of the second side of every seed: on the diagonal
  of that table both learnt together, off it they never met.

A win counts 1, a draw one half. Intervals of 95 % count games, not seeds. "Ended by" has the events of the control step
that ended a game; a game that ended without any, because time was up, has "time". Games without bodies have no events.
"""

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import numpy as np

from agents.rollout.rollout import PlayedEpisodes
from experiments.policy_files import (
    INITIAL,
    FileLeague,
    between_seeds,
    check_pairs,
    config_of,
    file_league,
    parser_of_pairs,
    score_of,
)
from league.commands.cli import guarded
from league.config.experiment import Config
from league.config.schema import ConfigError
from scripts.record import run_info, split_arguments, write
from storage.records import Match

TIME = "time"


def pairs_of(seeds: Sequence[str], sides: Sequence[str], initial: bool = False) -> Iterator[tuple[str, str]]:
    """Yield the pairs that could play, with an initial policy first; with `initial` alone of initial policies."""
    first, second = sides
    for seed in seeds:
        yield f"{seed}:{first}{INITIAL}", f"{seed}:{second}{INITIAL}"
        if not initial:
            yield f"{seed}:{first}", f"{seed}:{second}{INITIAL}"
            yield f"{seed}:{second}", f"{seed}:{first}{INITIAL}"
    if not initial:
        yield from ((f"{a}:{first}", f"{b}:{second}") for a in seeds for b in seeds)


def ends(games: PlayedEpisodes, teams: Sequence[str]) -> Counter[str]:
    """Count the recorded games, all but void ones, by the events of the control step that ended them.

    A text has a team and its event, such as "blue capture", and several of them joined by commas.
    """
    void = np.asarray(games.void)
    frames = games.frames
    over = np.asarray(frames.over).reshape(-1, np.shape(frames.over)[-1])  # (steps, games)
    last = over.argmax(axis=0)
    events = {name: np.asarray(each).reshape(*over.shape, len(teams)) for name, each in frames.events.items()}
    found: Counter[str] = Counter()
    for game in np.flatnonzero(~void).tolist():
        happened = [
            f"{team} {name}"
            for name, each in events.items()
            for t, team in enumerate(teams)
            if each[last[game], game, t]
        ]
        found[", ".join(happened) or TIME] += 1
    return found


def play(league: FileLeague, a: str, b: str, batches: int) -> tuple[list[Match], dict[str, Any]]:
    """Play a pair; return its rows, and what JSON has of it."""
    teams, ended, rows = [team.name for team in league.arena.teams], Counter(), []
    for batch in league.batches(a, b, batches):
        rows.append(batch.match)
        if league.evaluator.recorded:
            ended += ends(batch.games, teams)
    return rows, {**score_of(a, b, rows), **({"ended by": dict(ended.most_common())} if ended else {})}


def text_of(row: dict[str, Any]) -> str:
    """Return a pair's figures as a line."""
    score, ended = row["score"], row.get("ended by", {})
    how = "".join(f"; {what} {count}" for what, count in ended.items())
    voids = f", {row['voids']} void" if row["voids"] else ""
    told = f"{score['score']:.1%} ({score['low']:.1%}-{score['high']:.1%})"
    return f"{row['a']} against {row['b']}: {told} of {row['games']}{voids}{how}"


def parsed(argv: Sequence[str]) -> tuple[argparse.Namespace, Config, tuple[str, ...]]:
    """Return the arguments, the configuration of the arena, and its sides."""
    own, further = split_arguments(list(argv))
    parser = parser_of_pairs(__doc__)
    parser.add_argument("--arena", required=True, help="an arena of two teams")
    parser.add_argument("--initial", action="store_true", help="play initial policies of each seed alone")
    args = parser.parse_args(own)
    config = config_of(parser, args.arena, further)
    sides = tuple(config.arena.outline().teams)
    if len(sides) != 2:
        parser.error(f"{args.arena} has {len(sides)} teams; cross-play is of two")
    check_pairs(parser, args, sides)
    return args, config, sides


def main(argv: Sequence[str] | None = None) -> int:
    """Play all pairs, print the figures and write JSON after each pair."""
    args, config, sides = parsed(sys.argv[1:] if argv is None else argv)
    about = run_info(args.commit)
    about["command"] = about["command"].replace(str(args.folder), "OUT")
    result: dict[str, Any] = {**about, "arena": args.arena, "engine": "c", "seeds": args.seeds}
    matches: list[Match] = []
    with file_league(config, args.folder, args.seeds, sides, args.worlds) as league:
        result |= {"rules": league.arena.config_hash, "policies": league.policies(), "pairs": []}
        known = [pair for pair in pairs_of(args.seeds, sides, args.initial) if league.snapshots.keys() >= {*pair}]
        if not known:
            raise ConfigError(
                (), f"{args.folder} has no initial policies: SEED/{sides[0]}{INITIAL}.safetensors and others"
            )
        for a, b in known:
            began = time.monotonic()
            rows, row = play(league, a, b, args.episodes // args.worlds)
            matches += rows
            result["pairs"].append(row)
            print(f"{text_of(row)} ({time.monotonic() - began:.0f} s)", flush=True)
            write(result, args.out)
    if len(args.seeds) > 1 and not args.initial:
        result["cross_play"] = between_seeds(matches, args.seeds, sides)
        print(json.dumps({"cross_play": result["cross_play"]}), flush=True)
        write(result, args.out)
    return 0


if __name__ == "__main__":
    sys.exit(guarded(main))
