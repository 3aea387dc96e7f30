"""Two against two rovers, ten minutes of training on one GPU: what the newest snapshot is worth then.

    python benchmarks/rovers.py --store runs/rovers --out benchmarks/results/rovers-2v2-10min-h100.json

Trains by `league run`, in phases (`PHASES`): each goes on from where the one before it stopped, with other settings.
No script is ever met in training. Then every snapshot of both players plays the scripts and its own initial snapshot,
`--episodes` each, and each player's newest one plays every earlier snapshot of its own, twice as many; sides swapped.
The same command goes on where it was stopped.
"""

import argparse
import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment


from benchmarks.episodes import bare, rate, score  # noqa: E402
from benchmarks.record import commit, machine  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.config.durations import seconds  # noqa: E402
from league.evaluate import Referee  # noqa: E402
from league.jobs import RatingMatch  # noqa: E402
from league.measures import newest_snapshots  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.store import Store  # noqa: E402

LEAGUE = "rovers"
SETTINGS = [
    "--arena.name", "sumo-2v2", "--league", LEAGUE, "--workers.match", "0",
    "--rating.milestones", "30s,1m,2m,5m", "--training.snapshots-per-doubling", "2", "--training.turn", "64",
    "--training.rollout", "16", "--training.shaping-steps", "30000000", "--learner.gamma", "0.99",
    "--learner.architecture.hidden", "128,128",
]  # fmt: skip
PHASES: list[tuple[str, list[str]]] = [  # until so much training in all, with these settings
    ("6m30s", ["--training.worlds", "4096"]),
    # Larger batches and smaller steps at the end: less noise.
    ("10m", ["--training.worlds", "8192", "--learner.lr", "5e-4", "--learner.critic-lr", "5e-4",
             "--learner.entropy", "0.002"]),
]  # fmt: skip


def main() -> None:
    """Train, rate and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=512, help="for each pair of snapshots")
    parser.add_argument("--recordings", type=Path, help="keep recordings of the newest snapshots against scripts here")
    parser.add_argument("--phases", type=int, default=len(PHASES), help="stop after so many phases, without rating")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    args = parser.parse_args()
    began = time.time()
    for i in range(args.phases):
        train(args.store, args.seed, i)
    if args.phases == len(PHASES):
        result = {"commit": args.commit or commit(), **measure(args.store, args.episodes)}
        args.out.write_text(json.dumps(result, indent=1) + "\n")
        if args.recordings:
            record(args.store, args.recordings)
    print(f"{time.time() - began:.0f} s", flush=True)


def train(where: Path, seed: int, phase: int) -> None:
    """Train until the end of a phase, in processes of its own, unless that has been done."""
    until, flags = PHASES[phase]
    if where.exists():
        with Store.open(where) as store:
            newest = Standing.of(store, LEAGUE).newest
            if newest is not None and newest.seconds >= seconds(until):
                return
    command = [sys.executable, "-m", "league", "run", *SETTINGS, "--seed", str(seed), "--store", str(where)]
    subprocess.run([*command, "--budget.train", until, *flags], check=True)


def measure(where: Path, episodes: int) -> dict:
    """Rate what was trained, and tell it."""
    with Store.open(where) as store:
        config = configuration.loads(store.league(LEAGUE).config)
        standing = Standing.of(store, LEAGUE)
        last = standing.newest
        assert last is not None
        scripts = {s.script: s for s in standing.snapshots if s.script}
        told = [*(scripts[name] for name in ("pusher", "centre-holder"))]
        pairs = [(s, o) for p in standing.players for s in standing.history(p.name) for o in told]
        pairs += [(s, standing.history(p.name)[0]) for p in standing.players for s in standing.history(p.name)[1:]]
        newest = newest_snapshots(standing)
        pairs += [(s, o) for s in newest for o in standing.history(str(s.player))[1:-1]]
        pairs += [(s, scripts[name]) for s in newest for name in ("idle", "random")]
        pairs += [(s, o) for s, o in pairs if s in newest and o in (*told, *standing.history(str(s.player)))]
        ladder, voids, took = rate(store, config, LEAGUE, pairs, episodes)
        return {
            "machine": machine(),
            "versions": versions(),
            "settings": SETTINGS,
            "phases": PHASES,
            "runs": [bare(run.config) for run in store.runs(LEAGUE)],
            "training_seconds": round(last.seconds, 1),
            "iterations": last.iteration,
            "steps": last.step,
            "steps_per_second_learning_included": round(last.step / last.seconds),
            "rated_episodes": int(ladder.payoff.games.sum() // 2),
            "void_episodes": voids,
            "rating_seconds": round(took, 1),
            "newest": [
                {"snapshot": s.name, "against": o.name, "against_seconds": round(o.seconds, 1), **score(ladder, s, o)}
                for s in newest
                for o in [*scripts.values(), *standing.history(str(s.player))[:-1]]
            ],
            "curve": [
                {
                    "snapshot": s.name, "seconds": round(s.seconds, 1), "steps": s.step,
                    **{o.name: score(ladder, s, o) for o in told},
                    "initial": score(ladder, s, standing.history(p.name)[0]) if s.iteration else None,
                }
                for p in standing.players
                for s in standing.history(p.name)
            ],
        }  # fmt: skip


def record(where: Path, folder: Path) -> None:
    """Keep recordings of each newest snapshot against the pusher and the centre-holder."""
    folder.mkdir(parents=True, exist_ok=True)
    with Store.open(where) as store:
        config = configuration.loads(store.league(LEAGUE).config)
        config = replace(config, rating=replace(config.rating, worlds=16, pairings=8, record=True))
        standing = Standing.of(store, LEAGUE)
        scripts = [s for s in standing.snapshots if s.script in ("pusher", "centre-holder")]
        pairs = tuple((s.name, o.name) for s in newest_snapshots(standing) for o in scripts)
        referee = Referee(config, config.arena.build(engine=config.engine, worlds=16), LEAGUE)
        for i, match in enumerate(referee.play(store, RatingMatch(pairs, 1))):
            assert match.recording is not None
            path = folder / f"{match.a}-{match.b}-{i}.mcap".replace("@", "-")
            path.write_bytes(store.blobs.get(match.recording))


if __name__ == "__main__":
    main()
