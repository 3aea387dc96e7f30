"""Two against two rovers, ten minutes of training on one GPU: the strength of the newest snapshot.

    python -m experiments.rovers --store runs/rovers --out experiments/results/rovers-2v2-10min-h100.json

Trains by `league run`, in phases (`PHASES`) with different settings, each of which continues the one before. Training
meets no script. Then every snapshot of both players plays the scripts and its own initial snapshot, `--episodes` each,
and each player's newest snapshot plays all its earlier ones, twice as many; sides swapped. The same command continues
where it was stopped.
"""

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from league.system.environment import prepare

prepare()  # before jax reads the environment


from experiments.episodes import bare, rate, score
from league.config import experiment as configuration
from league.config.durations import seconds
from league.matches.evaluator import MatchEvaluator
from league.state.jobs import RatingMatch
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, write
from storage.store import Store

LEAGUE = "rovers"
SETTINGS = [
    "--arena.name", "sumo-2v2", "--league", LEAGUE, "--workers.match", "0",
    "--rating.milestones", "30s,1m,2m,5m", "--training.snapshots-per-doubling", "2",
    "--training.iterations_per_turn", "64",
    "--training.rollout_length", "16", "--training.shaping-steps", "30000000", "--learner.gamma", "0.99",
    "--learner.architecture.hidden", "128,128",
]  # fmt: skip
PHASES: list[tuple[str, list[str]]] = [  # training time at the end of the phase, settings
    ("6m30s", ["--training.worlds", "4096"]),
    # Larger batches and smaller learning rates at the end reduce noise.
    ("10m", ["--training.worlds", "8192", "--learner.lr", "5e-4", "--learner.critic-lr", "5e-4",
             "--learner.entropy_coef", "0.002"]),
]  # fmt: skip


def main() -> None:
    """Train, rate and write the JSON."""
    parser = make_parser(__doc__, out_required=True)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=512, help="for each pair of snapshots")
    parser.add_argument("--recordings", type=Path, help="keep recordings of the newest snapshots against scripts here")
    parser.add_argument("--phases", type=int, default=len(PHASES), help="stop after this many phases, without rating")
    args = parser.parse_args()
    began = time.time()
    for i in range(args.phases):
        train(args.store, args.seed, i)
    if args.phases == len(PHASES):
        result = measure(args.store, args.episodes)
        write({**run_info(args.commit), **result}, args.out)
        if args.recordings:
            record(args.store, args.recordings)
    print(f"{time.time() - began:.0f} s", flush=True)


def train(where: Path, seed: int, phase: int) -> None:
    """Train until the end of a phase, in processes of its own, unless that has been done."""
    until, flags = PHASES[phase]
    if where.exists():
        with Store.open(where) as store:
            newest = LeagueState.of(store, LEAGUE).newest
            if newest is not None and newest.seconds >= seconds(until):
                return
    command = [sys.executable, "-m", "league", "run", *SETTINGS, "--seed", str(seed), "--store", str(where)]
    subprocess.run([*command, "--budget.training_time", until, *flags], check=True)


def measure(where: Path, episodes: int) -> dict:
    """Rate the snapshots and return the figures."""
    with Store.open(where) as store:
        config = configuration.loads(store.league(LEAGUE).config)
        state = LeagueState.of(store, LEAGUE)
        last = state.newest
        assert last is not None
        scripts = {s.script: s for s in state.snapshots if s.script}
        anchors = [scripts[name] for name in ("pusher", "centre-holder")]
        pairs = [(s, o) for p in state.players for s in state.history(p.name) for o in anchors]
        pairs += [(s, state.history(p.name)[0]) for p in state.players for s in state.history(p.name)[1:]]
        newest = state.newest_snapshots
        pairs += [(s, o) for s in newest for o in state.history(str(s.player))[1:-1]]
        pairs += [(s, scripts[name]) for s in newest for name in ("idle", "random")]
        pairs += [(s, o) for s, o in pairs if s in newest and o in (*anchors, *state.history(str(s.player)))]
        ladder, voids, took = rate(store, config, LEAGUE, pairs, episodes)
        return {
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
                for o in [*scripts.values(), *state.history(str(s.player))[:-1]]
            ],
            "curve": [
                {
                    "snapshot": s.name, "seconds": round(s.seconds, 1), "steps": s.step,
                    **{o.name: score(ladder, s, o) for o in anchors},
                    "initial": score(ladder, s, state.history(p.name)[0]) if s.iteration else None,
                }
                for p in state.players
                for s in state.history(p.name)
            ],
        }  # fmt: skip


def record(where: Path, folder: Path) -> None:
    """Keep recordings of each newest snapshot against the pusher and the centre-holder."""
    folder.mkdir(parents=True, exist_ok=True)
    with Store.open(where) as store:
        config = configuration.loads(store.league(LEAGUE).config)
        config = replace(config, rating=replace(config.rating, worlds=16, pairings=8, record=True))
        state = LeagueState.of(store, LEAGUE)
        scripts = [s for s in state.snapshots if s.script in ("pusher", "centre-holder")]
        pairs = tuple((s.name, o.name) for s in state.newest_snapshots for o in scripts)
        evaluator = MatchEvaluator(config, config.arena.build(engine=config.engine, worlds=16), LEAGUE)
        for i, match in enumerate(evaluator.play(store, RatingMatch(pairs, 1))):
            assert match.recording is not None
            path = folder / f"{match.a}-{match.b}-{i}.mcap".replace("@", "-")
            path.write_bytes(store.blobs.get(match.recording))


if __name__ == "__main__":
    main()
