"""The first stages of HARL-A's curricula on one GPU: how soon robots alone learn their task, over seeds.

    python benchmarks/stages.py walk --seeds 1 2 3 --store runs/stages --out benchmarks/results/walk-h100.json
    python benchmarks/stages.py push-anymal --seeds 1 2 3 --store runs/stages --out benchmarks/results/push-h100.json

Trains by `league run` with nothing else on the GPU, each seed in a store of its own; a stage that goes on from another
finds that one's league in the same store. Then every snapshot plays `--episodes` fresh episodes: alone, or against
`idle` where the arena has two teams. A snapshot has succeeded where the lower end of its 95 % interval is above what
the stage asks. The same command goes on where it was stopped.
"""

import argparse
import json
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

from benchmarks.episodes import bare, rate, score  # noqa: E402
from benchmarks.record import commit, machine  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.store import Store  # noqa: E402

LEARNER = [
    "--learner.architecture.hidden", "128,128,128", "--learner.architecture.activation", "elu", "--learner.lr", "1e-3",
    "--learner.critic-lr", "1e-3", "--learner.gamma", "0.99", "--learner.initial-std", "0.6",
    "--learner.normalise-observations", "--training.rollout", "24", "--training.snapshots-per-doubling", "4",
    "--training.turn", "32", "--workers.match", "0",
]  # fmt: skip
"""As in the presets of these curricula."""


@dataclass(frozen=True)
class Stage:
    """A stage to be shown: where, for how long, what is asked, and from which stage it goes on."""

    arena: str
    train: str
    asked: float
    after: str = ""
    settings: tuple[str, ...] = ()


STAGES = {
    "walk": Stage("anymal-walk", "10m", 0.9),
    "push-anymal": Stage("block-push-anymal", "15m", 0.8, "walk", ("--training.shaping-steps", "50000000")),
    "push-leatherback": Stage("block-push-leatherback", "15m", 0.8, "", ("--training.shaping-steps", "50000000")),
}


def main() -> None:
    """Train, play and write the JSON after each seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", choices=STAGES)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the seeds' stores")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--train", help="train for so long (default: as the stage says)")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--episodes", type=int, default=512, help="for each snapshot")
    parser.add_argument("--batch", type=int, default=8192, help="of them at once")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("flags", nargs="*", help="further flags of `league run`, after --")
    args = parser.parse_args()
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "machine": machine(),
        "versions": versions(), "asked": STAGES[args.stage].asked, "seeds": [],
    }  # fmt: skip
    for seed in args.seeds:
        store = args.store / f"seed{seed}"
        train(args, store, seed)
        result["seeds"].append({"seed": seed, **measure(args, store)})
        args.out.write_text(json.dumps(result, indent=1) + "\n")
        print(json.dumps({k: v for k, v in result["seeds"][-1].items() if k not in ("curve", "runs")}), flush=True)


def train(args: argparse.Namespace, store: Path, seed: int) -> None:
    """Train until the stage's time is over, in processes of its own."""
    stage = STAGES[args.stage]
    after = ["--after", stage.after] if stage.after else []
    command = [
        sys.executable, "-m", "league", "run", "--store", str(store), "--league", args.stage,
        "--arena.name", stage.arena,
        *LEARNER, *stage.settings, *after, "--training.worlds", str(args.worlds), "--seed", str(seed),
        "--budget.train", args.train or stage.train, "--budget.rate", "0s", *args.flags,
    ]  # fmt: skip
    subprocess.run(command, check=True)


def measure(args: argparse.Namespace, where: Path) -> dict:
    """Play each snapshot's episodes, and tell the curve and when it had what is asked."""
    asked = STAGES[args.stage].asked
    with Store.open(where) as store:
        config = configuration.loads(store.league(args.stage).config)
        standing = Standing.of(store, args.stage)
        last = standing.newest
        assert last is not None
        idle = None if standing.one_team else next(s for s in standing.snapshots if s.script == "idle")
        own = [s for player in standing.players for s in standing.history(player.name)]
        began = time.monotonic()
        ladder, voids, _ = rate(store, config, args.stage, [(s, idle) for s in own], args.episodes, args.batch)
        curve = [
            {"snapshot": s.name, "seconds": round(s.seconds, 1), "steps": s.step, **score(ladder, s, idle)} for s in own
        ]
        return {
            "training_seconds": round(last.seconds, 1),
            "iterations": last.iteration,
            "steps": last.step,
            "steps_per_second_learning_included": round(last.step / last.seconds),
            "against": "idle" if idle else None,
            "reached": {
                player.name: next((p for p in curve if p["low"] > asked and p["snapshot"] in names), None)
                for player in standing.players
                for names in [{s.name for s in standing.history(player.name)}]
            },
            "newest": [curve[own.index(standing.history(player.name)[-1])] for player in standing.players],
            "void_episodes": voids,
            "rating_seconds": round(time.monotonic() - began, 1),
            "runs": [bare(run.config) for run in store.runs(args.stage)],
            "curve": curve,
        }


if __name__ == "__main__":
    main()
