"""The quick start over seeds: time to the first learning step, speed, and score over training time.

    python -m benchmarks.quickstart --seeds 1 2 3 --out benchmarks/results/quickstart-cpu.json

Each seed runs `league run --preset quickstart` for five minutes in a folder of its own. Afterwards every snapshot of
both players plays its player's initial snapshot, which gives a point of the learning curve each.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax

from league.config import experiment as configuration
from league.config import presets
from league.matches.evaluator import MatchEvaluator
from league.scheduling.progress_metrics import reference_opponents
from league.state.jobs import RatingMatch
from league.state.league_state import LeagueState
from matchmaking.ratings.ladder import Ladder
from scripts.record import make_parser, run_info, write
from storage.store import Store

EPISODES = 256
LENGTH = ("--budget.training_time", "5m", "--budget.rating_time", "2m")  # of the figures in docs/results.md


def main() -> None:
    """Run the seeds and write the JSON."""
    parser = make_parser(__doc__, out_required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--keep", type=Path, help="keep the leagues in this folder")
    parser.add_argument("flags", nargs="*", help="further flags of `league run`, after --")
    args = parser.parse_args()
    result = {**run_info(args.commit), "bare_batch": bare_batch(), "seeds": []}
    for seed in args.seeds:
        with tempfile.TemporaryDirectory() as folder:
            where = Path(args.keep or folder) / f"seed{seed}"
            result["seeds"].append(one_seed(seed, where, args.flags))
            write(result, args.out)
            print(json.dumps({k: v for k, v in result["seeds"][-1].items() if k != "curve"}, indent=1), flush=True)


def one_seed(seed: int, where: Path, flags: list[str]) -> dict:
    """Run one league and read its figures from its store."""
    began = time.time()
    command = [sys.executable, "-m", "league", "run", "--preset", "quickstart", *LENGTH]
    subprocess.run([*command, "--seed", str(seed), "--store", str(where), *flags], check=True)
    wall = time.time() - began
    with Store.open(where) as store:
        league = "quickstart"
        config = configuration.loads(store.league(league).config)
        state = LeagueState.of(store, league)
        first = min(c.created - c.seconds for c in store.checkpoints(league) if c.iteration > 0)
        last = state.newest
        assert last is not None
        played = store.matches(league, "rating")
        return {
            "seed": seed,
            "wall_seconds": round(wall, 1),
            "seconds_to_first_learning_step": round(first - began, 1),
            "training_seconds": round(last.seconds, 1),
            "steps": last.step,
            "steps_per_second_learning_included": round(last.step / last.seconds),
            "control_steps_per_second": round(last.step / last.seconds * config.arena.rules.decide_every),
            "snapshots_per_player": len(state.history("blue")),
            "rated_episodes": sum(m.wins + m.draws + m.losses for m in played),
            "void_episodes": sum(m.voids for m in played),
            "newest": [
                {
                    "snapshot": s.name,
                    "against": o.name,
                    "against_seconds": round(o.seconds, 1),
                    **score(state.ladder, s, o),
                }
                for s in state.newest_snapshots
                for o in reference_opponents(config, state, s)
                if state.ladder.score(s.name, o.name).games
            ],
            "curve": curve(store, config, state),
        }


def score(ladder: Ladder, snapshot, other) -> dict:
    """Return a score with its 95 % interval and number of games."""
    found = ladder.score(snapshot.name, other.name)
    return {"score": round(found.score, 4), "low": round(found.low, 4), "high": round(found.high, 4), "n": found.games}


def curve(store: Store, config, state: LeagueState) -> list[dict]:
    """Play every snapshot of both players against its initial one, sides swapped; return their scores."""
    arena = config.arena.build(engine=config.engine, worlds=config.rating.worlds)
    evaluator = MatchEvaluator(config, arena, "quickstart")
    pairs = [(s, state.history(p.name)[0]) for p in state.players for s in state.history(p.name)[1:]]
    matches = []
    for i in range(0, len(pairs), evaluator.pairings):
        batch = tuple((a.name, b.name) for a, b in pairs[i : i + evaluator.pairings])
        for repeat in range(-(-EPISODES // (2 * evaluator.each))):
            matches += evaluator.play(store, RatingMatch(batch, 10_000 + 100 * i + repeat))
    ladder = Ladder([s.name for s in state.snapshots], matches)
    return [
        {"player": s.player, "iteration": s.iteration, "seconds": round(s.seconds, 1), **score(ladder, s, start)}
        for s, start in pairs
    ]


def bare_batch(worlds: int = 256, seconds: float = 10.0) -> dict:
    """Return control steps/s of `mujoco.batch.Batch` alone on the quick start's model, with random controls."""
    from mujoco.batch import Batch

    arena = presets.preset("quickstart").arena.build(engine="c")
    batch = Batch(arena.scene.model, worlds)
    batch.bind("qpos")[:] = np.asarray(arena.place(jax.random.key(0))[0])
    ctrl = batch.bind("ctrl")
    rng = np.random.default_rng(0)
    limits = np.array([60.0] * 4 + [0.6] * 2)
    rates = []
    for _ in range(3):
        began, steps = time.monotonic(), 0
        while time.monotonic() - began < seconds / 3:
            ctrl[:] = rng.uniform(-1, 1, (worlds, len(arena.robots), 6)).reshape(worlds, -1) * np.tile(limits, 4)
            batch.step(nstep=arena.timing.substeps * arena.timing.hold)
            steps += arena.timing.hold * worlds
        rates.append(steps / (time.monotonic() - began))
    return {"worlds": worlds, "control_steps_per_second": [round(r) for r in rates]}


if __name__ == "__main__":
    main()
