"""What a setting is worth: leagues that differ in it alone, over seeds, and then all of them against all.

    python benchmarks/ablations.py buffer --seeds 1 2 3 --store runs/ablations --out benchmarks/results/buffer-h200.json
    python benchmarks/ablations.py critics --variants own all --seeds 1 --store runs/ablations   # trains, no --out
    python benchmarks/ablations.py critics --seeds 1 2 3 --store runs/ablations --out ...        # the rest, then plays

Every variant learns for the same number of environment steps from each seed, in a store of its own, so that several of
these commands may share the work between GPUs; what has been trained is not trained again, and what follows `--` are
further flags of `league run`. With `--out` it then tells

- when each learning curve first had a reward or a score: by mean of ten iterations, the first of which has the value;
- in an arena of two teams, a table: the newest snapshot of each variant and seed against those of all others,
  `--episodes` each, and the mean of a variant against another over their seeds;
- for `buffer`, what its zeros do to the layer norm of the input (`norms`);
- with `--exploit STEPS`, what fresh attackers who learn for so long against each variant's newest snapshots, and
  nobody else, win from them: what of a score of one half a policy can lose.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from pathlib import Path

import numpy as np

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

import league  # noqa: E402
from benchmarks.episodes import bare, rate, score  # noqa: E402
from benchmarks.record import commit, machine, own_and_further, spread  # noqa: E402
from league import exchange  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.create import create  # noqa: E402
from league.measures import newest_snapshots  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402
from storage import arrays  # noqa: E402
from storage.records import CurvePoint, Snapshot  # noqa: E402
from storage.store import Store  # noqa: E402

Flags = Mapping[str, str]
WINDOW = 10  # learning iterations whose mean has to have a value

PLAIN = {"budget.rate": "0s", "workers.match": "0", "training.turn": "32", "rating.scripts": "[]"}
WALK = {
    "learner.lr": "1e-3", "learner.critic-lr": "1e-3", "learner.gamma": "0.99", "learner.initial-std": "0.6",
    "learner.architecture.hidden": "128,128,128", "learner.architecture.activation": "elu", "training.rollout": "24",
}  # fmt: skip
"""As in the presets of HARL-A's curricula."""
MATCH = WALK | {
    "learner.lr": "3e-4", "learner.gamma": "0.995", "learner.normalise-observations": "true",
    "training.rollout": "48", "training.shaping-steps": "0", "training.worlds": "8192",
}  # fmt: skip
"""As in benchmarks/stages.py."""
ROVERS = {
    "training.rollout": "16", "training.shaping-steps": "30000000", "learner.gamma": "0.99",
    "learner.architecture.hidden": "128,128", "training.worlds": "4096",
}  # fmt: skip
"""As in benchmarks/rovers.py."""


@dataclass(frozen=True)
class Ablation:
    """Leagues that shall be compared: what is common, and what each variant sets."""

    arena: str
    steps: int  # environment steps of training, of each variant and seed
    variants: Mapping[str, Flags]
    settings: Flags = field(default_factory=dict)
    reached: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # figure of the curve -> thresholds


def _buffers(norm: str, flags: Flags) -> dict[str, Flags]:
    return {f"{norm}-{size}": {"arena.buffer": str(size), "training.worlds": "4096", **flags} for size in (0, 50, 100)}


SUCCESS = {"training.shaping-until": "0.9"}  # hints fade by success; else over 50 million steps
STRONG = {"arena.reward.approach": "1", "arena.reward.push": "4"}  # hints; else 0.5 and 1
LONG = {"learner.gamma": "0.997"}  # 7 s; else 0.99, 2 s
EASY = {"arena.rules.ease": "1"}  # all episodes begin on the way to the goal, with a part of it left
RESTLESS = {"arena.reward.near": "0", "arena.reward.ball": "0"}  # nothing is paid for standing anywhere
FREE = {"arena.rules.drive-scale": "40", "arena.rules.steer-scale": "0.5"}  # full throttle is 1.25 and not 5 units
CAREFUL = {"learner.lr": "3e-4", "learner.kl-step": "0.01"}
SCORE = WALK | {"learner.normalise-observations": "true", "training.worlds": "4096"}


LAYER_NORM = {"learner.architecture.layer-norm": "true"}
CRITICS: Mapping[str, Flags] = {kind: {"learner.critic-input": kind} for kind in ("own", "all", "same", "privileged")}
OPPONENTS: Mapping[str, Flags] = {
    "latest": {},
    "past": {"training.opponents.kind": "uniform", "training.opponents.past": "0.5"},
    "recent": {
        "training.opponents.kind": "delta_uniform",
        "training.opponents.past": "0.5",
        "training.opponents.delta": "0.5",
    },
}
QUICK = {"training.device": "cpu"}
"""All else as in the quick start: 256 worlds, 32 decisions an iteration, on two cores."""
ABLATIONS = {
    "buffer": Ablation(
        "anymal-walk", 40_000_000,
        _buffers("layer-norm", LAYER_NORM) | _buffers("statistics", {"learner.normalise-observations": "true"}),
        WALK, {"score": (0.5, 0.9), "reward": (0.0, 5.0)},
    ),
    "score-anymal": Ablation(
        "soccer-score", 30_000_000,
        {
            "steps": {"training.shaping-steps": "50000000"},
            "strong-long": SUCCESS | STRONG | LONG,
            "easy": SUCCESS | STRONG | LONG | EASY | RESTLESS,
            "careful": SUCCESS | STRONG | LONG | EASY | RESTLESS | CAREFUL,
            "brave": SUCCESS | STRONG | LONG | EASY | RESTLESS | CAREFUL | {"arena.reward.fall": "-0.5"},
        },
        SCORE | {"after": "anymal-ball"}, {"score": (0.1, 0.7)},
    ),
    "score-leatherback": Ablation(
        "soccer-score-leatherback", 36_000_000,
        {
            "steps": {"training.shaping-steps": "50000000"},
            "strong-long": SUCCESS | STRONG | LONG,
            "easy": SUCCESS | STRONG | LONG | EASY | RESTLESS,
            "free": SUCCESS | STRONG | LONG | EASY | RESTLESS | FREE,
            "careful": SUCCESS | STRONG | LONG | EASY | RESTLESS | FREE | CAREFUL,
            "far": SUCCESS | STRONG | LONG | RESTLESS | FREE | CAREFUL,
        },
        SCORE, {"score": (0.1, 0.7)},
    ),
    "critics": Ablation(
        "sumo-by-team", 40_000_000, CRITICS, MATCH | {"after": "leatherback-push,anymal-push"},
    ),
    "critics-rovers": Ablation("sumo-2v2", 2_500_000, CRITICS, QUICK),
    "opponents": Ablation("sumo-2v2", 15_000_000, OPPONENTS, ROVERS | {"training.snapshots-per-doubling": "2"}),
    "opponents-quick": Ablation("sumo-2v2", 2_500_000, OPPONENTS, QUICK),
}  # fmt: skip


def main() -> None:
    """Train what has not been trained, then tell what came of all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ablation", choices=ABLATIONS)
    parser.add_argument("--variants", nargs="+", help="train these alone, and tell of these (default: all)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the leagues' stores")
    parser.add_argument("--out", type=Path, help="tell of the variants, here (default: train only)")
    parser.add_argument("--steps", type=int, help="of training (default: as the ablation says)")
    parser.add_argument("--episodes", type=int, default=512, help="for each pair of snapshots")
    parser.add_argument("--batch", type=int, default=8192, help="of them at once")
    parser.add_argument("--exploit", type=int, metavar="STEPS", help="let attackers learn for so long, of each player")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    own, further = own_and_further(sys.argv[1:])
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    ablation = ABLATIONS[args.ablation]
    if unknown := set(args.variants or ()) - set(ablation.variants):
        parser.error(f"--variants {' '.join(sorted(unknown))}: choose of {', '.join(ablation.variants)}")
    chosen = {name: flags for name, flags in ablation.variants.items() if name in (args.variants or ablation.variants)}
    ablation = replace(ablation, steps=args.steps or ablation.steps, variants=chosen)
    for variant, seed in product(ablation.variants, args.seeds):
        train(ablation, variant, seed, place(args, variant, seed), args.flags)
        if args.exploit:
            exploited(args, variant, seed)
    if args.out is None:
        return
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "machine": machine(),
        "versions": versions(), "arena": ablation.arena, "steps": ablation.steps, "seeds": args.seeds,
        "variants": {variant: told(args, ablation, variant) for variant in ablation.variants},
    }  # fmt: skip
    result |= crossed(args, ablation)
    args.out.write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps({k: v for k, v in result.items() if k in ("variants", "mean")}, indent=1), flush=True)


def place(args: argparse.Namespace, variant: str, seed: int) -> Path:
    """The folder of a league's store."""
    return args.store / args.ablation / f"{variant}-{seed}"


def train(ablation: Ablation, variant: str, seed: int, store: Path, flags: list[str]) -> None:
    """Train a variant from a seed, in processes of its own, until it has learnt for the ablation's steps."""
    if store.exists():
        with Store.open(store) as opened:
            newest = Standing.of(opened, variant).newest
            if newest is not None and newest.step >= ablation.steps:
                return
    settings = {
        "store": str(store), "league": variant, "arena.name": ablation.arena, "seed": str(seed),
        "budget.steps": str(ablation.steps), **PLAIN, **ablation.settings, **ablation.variants[variant],
    }  # fmt: skip
    told = [f"--{name}={value}" for name, value in settings.items()]
    if code := subprocess.run([sys.executable, "-m", "league", "run", *told, *flags], check=False).returncode:
        sys.exit(code)  # it has said why


def exploited(args: argparse.Namespace, variant: str, seed: int) -> list[dict]:
    """What attackers win from a league's newest snapshots; once they have learnt, the same answer without training."""
    where = place(args, variant, seed)
    with Store.open(where) as store:
        victims = [s.name for s in newest_snapshots(Standing.of(store, variant))]
    found = []
    for victim in victims:
        asked = ("--budget", str(args.exploit), "--episodes", str(2 * args.episodes), "--format", "json")
        command = [
            sys.executable,
            "-m",
            "league",
            "exploit",
            victim,
            "--store",
            str(where),
            "--league",
            variant,
            *asked,
        ]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            sys.exit(done.returncode)  # it has said why
        found.append({k: v for k, v in json.loads(done.stdout).items() if k != "lineage"})
    return found


def told(args: argparse.Namespace, ablation: Ablation, variant: str) -> dict:
    """What a variant's curves say, by seed, and when they first had each threshold, in environment steps."""
    seeds = []
    for seed in args.seeds:
        with Store.open(place(args, variant, seed)) as store:
            players = {p.name: store.curves(variant, p.name) for p in store.players(variant)}
            seeds.append({
                "seed": seed,
                "steps": {name: points[-1].step for name, points in players.items()},
                "seconds": {name: round(points[-1].seconds, 1) for name, points in players.items()},
                "reached": {name: list(firsts(points, ablation.reached)) for name, points in players.items()},
                "last": {name: means(points) for name, points in players.items()},
                "norms": {s.name: n for s in newest_snapshots(Standing.of(store, variant)) if (n := norms(store, s))},
                "run": bare(store.runs(variant)[0].config),
            })  # fmt: skip
        if args.exploit:
            seeds[-1]["exploited"] = exploited(args, variant, seed)
    return {"flags": dict(ablation.variants[variant]), "seeds": seeds}


def firsts(points: list[CurvePoint], reached: Mapping[str, tuple[float, ...]]) -> Iterator[dict]:
    """The environment steps after which a figure's mean over WINDOW iterations was first at each threshold, or none."""
    for figure, thresholds in reached.items():
        values = np.array([point.values.get(figure, np.nan) for point in points])
        smooth = np.convolve(np.nan_to_num(values, nan=-np.inf), np.ones(WINDOW) / WINDOW, "valid")
        for threshold in thresholds:
            above = np.flatnonzero(smooth >= threshold)
            steps = points[int(above[0]) + WINDOW - 1].step if len(above) else None
            yield {"figure": figure, "at": threshold, "steps": steps}


def means(points: list[CurvePoint]) -> dict[str, float]:
    """The last iterations' mean score, reward and entropy."""
    names = ("score", "reward", "entropy", "explained_variance")
    found = {name: [p.values[name] for p in points[-WINDOW:] if name in p.values] for name in names}
    return {name: round(float(np.mean(values)), 4) for name, values in found.items() if values}


def norms(store: Store, snapshot: Snapshot) -> dict:
    """What the layer norm of an actor's input has learnt: the spread of its weights, of all inputs and the last 50."""
    held = arrays.from_bytes(store.blobs.get(snapshot.digest))
    if "0/trunk.norm.0.weight" not in held:
        return {}
    weight, first = held["0/trunk.norm.0.weight"], held["0/trunk.hidden.0.weight"]
    size = np.abs(first).mean(axis=0)  # (inputs,) how much the first layer makes of each
    return {
        "gain": spread(weight),
        "inputs": len(weight),
        "first_layer": spread(size),
        "its_last_50": spread(size[-50:]),
    }


def crossed(args: argparse.Namespace, ablation: Ablation) -> dict:
    """All newest snapshots of one team against those of the other, or of all others where teams are alike."""
    first, *_ = product(ablation.variants, args.seeds)
    with Store.open(place(args, *first)) as store:
        config = replace(configuration.loads(store.league(first[0]).config), after=())
    arena = config.arena.build(engine=config.engine, worlds=2)
    if len(arena.teams) != 2:
        return {}
    folder = args.store / args.ablation / "crossed"
    whose: dict[str, tuple[str, str, str]] = {}  # snapshot's name here -> variant, seed, roster
    with Store.open(folder, create=not folder.exists()) as store:
        create(store, replace(config, league="crossed"), arena)
        for variant, seed in product(ablation.variants, args.seeds):
            whose |= brought(folder, place(args, variant, seed), variant, seed)
        here = {s.name: s for s in store.snapshots("crossed")}
        names = list(combinations(whose, 2))
        rosters = {roster for *_, roster in whose.values()}
        pairs = [
            (here[a], here[b]) for a, b in names
            if whose[a][:2] != whose[b][:2] and (len(rosters) == 1 or whose[a][2] != whose[b][2])
        ]  # fmt: skip
        ladder, voids, seconds = rate(store, config, "crossed", pairs, args.episodes, args.batch)
    table = [{"a": a.name, "b": b.name, **score(ladder, a, b)} for a, b in pairs]
    return {"table": table, "mean": of_variants(table, whose), "voids": voids, "rating_seconds": round(seconds, 1)}


def brought(folder: Path, source: Path, variant: str, seed: int) -> dict[str, tuple[str, str, str]]:
    """Bring a league's newest snapshots into the store where all meet: their names there, and whose they are."""
    found = {}
    with league.open(source) as of, league.open(folder) as into:
        for snapshot in newest_snapshots(Standing.of(of.store, variant)):
            name = f"{variant}-{seed}-{snapshot.player}"
            if name not in {s.name for s in into.store.snapshots("crossed")}:
                exchange.bring_in(into, exchange.export(of, snapshot.name), name)
            found[name] = (variant, str(seed), snapshot.roster)
    return found


def of_variants(table: list[dict], whose: Mapping[str, tuple[str, str, str]]) -> dict[str, dict]:
    """The mean score of each variant against each other, by its roster, over all pairs of seeds, and its spread."""
    found: dict[str, list[float]] = {}
    alike = len({roster for *_, roster in whose.values()}) == 1
    for row in table:
        for a, b, value in ((row["a"], row["b"], row["score"]), (row["b"], row["a"], 1 - row["score"])):
            who = whose[a][0] if alike else f"{whose[a][0]} ({whose[a][2]})"
            found.setdefault(f"{who} against {whose[b][0]}", []).append(value)
    return {name: {**spread(values), "mean": round(float(np.mean(values)), 4), "pairs": len(values)}
            for name, values in sorted(found.items())}  # fmt: skip


if __name__ == "__main__":
    main()
