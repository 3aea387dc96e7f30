"""The quick start as a stranger runs it, over seeds: how soon it learns, how fast, and how well it plays by time.

    python benchmarks/quickstart.py --seeds 1 2 3 --out benchmarks/results/quickstart-cpu.json

Each seed runs `league run --preset quickstart` in a folder of its own; afterwards every snapshot of both players plays
its own initial snapshot, so that the curve has a point for each.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

import jax  # noqa: E402

from benchmarks.record import commit, machine  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.config import presets  # noqa: E402
from league.evaluate import Referee  # noqa: E402
from league.jobs import RatingMatch  # noqa: E402
from league.measures import newest_snapshots, yardsticks  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402
from matchmaking.ladder import Ladder  # noqa: E402
from storage.store import Store  # noqa: E402

EPISODES = 256


def main() -> None:
    """Run the seeds and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--keep", type=Path, help="keep the leagues in this folder")
    parser.add_argument("flags", nargs="*", help="further flags of `league run`, after --")
    args = parser.parse_args()
    result = {"machine": machine(), "versions": versions(), "commit": commit(), "bare_batch": bare_batch(), "seeds": []}
    for seed in args.seeds:
        with tempfile.TemporaryDirectory() as folder:
            where = Path(args.keep or folder) / f"seed{seed}"
            result["seeds"].append(one_seed(seed, where, args.flags))
            args.out.write_text(json.dumps(result, indent=1) + "\n")
            print(json.dumps({k: v for k, v in result["seeds"][-1].items() if k != "curve"}, indent=1), flush=True)


def one_seed(seed: int, where: Path, flags: list[str]) -> dict:
    """Run one league and read off its store what it did."""
    began = time.time()
    command = [
        sys.executable,
        "-m",
        "league",
        "run",
        "--preset",
        "quickstart",
        "--seed",
        str(seed),
        "--store",
        str(where),
    ]
    subprocess.run([*command, *flags], check=True)
    wall = time.time() - began
    with Store.open(where) as store:
        league = "quickstart"
        config = configuration.loads(store.league(league).config)
        standing = Standing.of(store, league)
        first = min(c.created - c.seconds for c in store.checkpoints(league) if c.iteration > 0)
        last = standing.newest
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
            "snapshots_per_player": len(standing.history("blue")),
            "rated_episodes": sum(m.wins + m.draws + m.losses for m in played),
            "void_episodes": sum(m.voids for m in played),
            "newest": [
                {
                    "snapshot": s.name,
                    "against": o.name,
                    "against_seconds": round(o.seconds, 1),
                    **score(standing.ladder, s, o),
                }
                for s in newest_snapshots(standing)
                for o in yardsticks(config, standing, s)
                if standing.ladder.score(s.name, o.name).games
            ],
            "curve": curve(store, config, standing),
        }


def score(ladder: Ladder, snapshot, other) -> dict:
    """Score with its 95 % interval."""
    found = ladder.score(snapshot.name, other.name)
    return {"score": round(found.score, 4), "low": round(found.low, 4), "high": round(found.high, 4), "n": found.games}


def curve(store: Store, config, standing: Standing) -> list[dict]:
    """Every snapshot of both players against its own initial one, sides swapped."""
    arena = config.arena.build(engine=config.engine, worlds=config.rating.worlds)
    referee = Referee(config, arena, "quickstart")
    pairs = [(s, standing.history(p.name)[0]) for p in standing.players for s in standing.history(p.name)[1:]]
    matches = []
    for i in range(0, len(pairs), referee.pairings):
        batch = tuple((a.name, b.name) for a, b in pairs[i : i + referee.pairings])
        for repeat in range(-(-EPISODES // (2 * referee.each))):
            matches += referee.play(store, RatingMatch(batch, 10_000 + 100 * i + repeat))
    ladder = Ladder([s.name for s in standing.snapshots], matches)
    return [
        {"player": s.player, "iteration": s.iteration, "seconds": round(s.seconds, 1), **score(ladder, s, start)}
        for s, start in pairs
    ]


def bare_batch(worlds: int = 256, seconds: float = 10.0) -> dict:
    """`mujoco.batch.Batch` alone on the quick start's model: control steps per second with random controls."""
    from mujoco.batch import Batch

    arena = presets.quickstart().arena.build(engine="c")
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
