"""Value of a setting: leagues that differ only in it, over seeds, and then played against each other.

    python -m experiments.ablations buffer --seeds 1 2 3 --store runs/ablations --out buffer-h200.json
    python -m experiments.ablations critics --variants own all --seeds 1 --store runs/ablations   # trains; no --out
    python -m experiments.ablations critics --seeds 1 2 3 --store runs/ablations --out ...        # the rest, then plays

Every variant trains for the same number of environment steps from each seed, in a store of its own, so that several of
these commands can share the work between GPUs. Variants that are already trained are not trained again. Arguments after
`--` are further flags of `league run`. With `--out` the result has:

- when each learning curve first reached given scores or rewards, by the mean of ten iterations;
- in an arena of two teams, a table of the newest snapshot of each variant and seed against those of all others,
  `--episodes` each, and the mean score of each variant against each other over their seeds;
- for `buffer`, the effect of its zeros on the layer norm of the input (`norms`);
- with `--exploit STEPS`, the score that newly trained attackers reach against each variant's newest snapshots, which
  bounds the exploitability of a policy from below.
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

from league.system.environment import prepare

prepare()  # before jax reads the environment

import league
from experiments.episodes import bare, rate, score
from league.config import experiment as configuration
from league.runtime.bootstrap import create
from league.snapshots import policy_file
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, split_arguments, spread, write
from storage.blobs import arrays
from storage.records import CurvePoint, Snapshot
from storage.store import Store

Flags = Mapping[str, str]
WINDOW = 10  # learning iterations over which a curve is averaged
SAMPLES = 20_000  # draws of the seeds for an interval

PLAIN = {"budget.rating_time": "0s", "workers.match": "0", "training.iterations_per_turn": "32", "rating.scripts": "[]"}
WALK = {
    "learner.lr": "1e-3", "learner.critic-lr": "1e-3", "learner.gamma": "0.99", "learner.initial-std": "0.6",
    "learner.architecture.hidden": "128,128,128", "learner.architecture.activation": "elu",
    "training.rollout_length": "24",
}  # fmt: skip
"""As in the presets of HARL-A's curricula."""
MATCH = WALK | {
    "learner.lr": "3e-4", "learner.gamma": "0.995", "learner.normalise-observations": "true",
    "training.rollout_length": "48", "training.shaping-steps": "0", "training.worlds": "8192",
}  # fmt: skip
"""As in experiments/stages.py."""
ROVERS = {
    "training.rollout_length": "16", "training.shaping-steps": "30000000", "learner.gamma": "0.99",
    "learner.architecture.hidden": "128,128", "training.worlds": "4096",
}  # fmt: skip
"""As in experiments/rovers.py."""


@dataclass(frozen=True)
class Ablation:
    """Leagues to compare: their common settings, and those of each variant."""

    arena: str
    steps: int  # environment steps of training, of each variant and seed
    variants: Mapping[str, Flags]
    settings: Flags = field(default_factory=dict)
    reached: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # figure of the curve -> thresholds


def _buffers(norm: str, flags: Flags) -> dict[str, Flags]:
    return {f"{norm}-{size}": {"arena.buffer": str(size), "training.worlds": "4096", **flags} for size in (0, 50, 100)}


SUCCESS = {"training.shaping-until": "0.9"}  # the dense reward fades by success instead of over 50 million steps
STRONG = {"arena.reward.approach": "1", "arena.reward.push": "4"}  # dense reward; default 0.5 and 1
LONG = {"learner.gamma": "0.997"}  # horizon of 7 s; default 0.99, 2 s
EASY = {"arena.rules.ease": "1"}  # all episodes begin close to the goal
RESTLESS = {"arena.reward.near": "0", "arena.reward.ball": "0"}  # no reward for standing at a place
FREE = {"arena.rules.drive-scale": "40", "arena.rules.steer-scale": "0.5"}  # full throttle is 1.25 instead of 5 units
CAREFUL = {"learner.lr": "3e-4", "learner.desired-kl": "0.01"}
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
"""Otherwise as in the quick start: 256 worlds, 32 decisions per iteration, on two cores."""
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
    "sharing-quick": Ablation(
        "sumo-2v2", 900_000, {"own": {}, "shared": {"learner.share-actors": "true"}}, QUICK,
    ),
    "horizons-quick": Ablation(
        "sumo-2v2", 900_000, {
            "0.95": {}, "0.98": {"learner.gae-lambda": "0.98"}, "1": {"learner.gae-lambda": "1"},
            "long": {"learner.gae-lambda": "1", "training.rollout-length": "100", "learner.minibatches": "12"},
        }, QUICK,
    ),
}  # fmt: skip


def main() -> None:
    """Train what has not been trained, then compare all variants."""
    parser = make_parser(__doc__)
    parser.add_argument("ablation", choices=ABLATIONS)
    parser.add_argument("--variants", nargs="+", help="train and compare only these (default: all)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--store", type=Path, required=True, help="the folder for the leagues' stores")
    parser.add_argument("--steps", type=int, help="of training (default: the ablation's)")
    parser.add_argument("--episodes", type=int, default=512, help="for each pair of snapshots")
    parser.add_argument("--batch", type=int, default=8192, help="of them at once")
    parser.add_argument("--exploit", type=int, metavar="STEPS", help="train attackers of each player for this long")
    own, further = split_arguments(sys.argv[1:])
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
        **run_info(args.commit), "arena": ablation.arena, "steps": ablation.steps, "seeds": args.seeds,
        "variants": {variant: learning(args, ablation, variant) for variant in ablation.variants},
    }  # fmt: skip
    result |= crossed(args, ablation)
    write(result, args.out)
    print(json.dumps({k: v for k, v in result.items() if k in ("variants", "mean")}, indent=1), flush=True)


def place(args: argparse.Namespace, variant: str, seed: int) -> Path:
    """Return the folder of a league's store."""
    return args.store / args.ablation / f"{variant}-{seed}"


def train(ablation: Ablation, variant: str, seed: int, store: Path, flags: list[str]) -> None:
    """Train a variant from a seed for the ablation's steps, in processes of its own, unless that has been done."""
    if store.exists():
        with Store.open(store) as opened:
            newest = LeagueState.of(opened, variant).newest
            if newest is not None and newest.step >= ablation.steps:
                return
    settings = {
        "store": str(store), "league": variant, "arena.name": ablation.arena, "seed": str(seed),
        "budget.steps": str(ablation.steps), **PLAIN, **ablation.settings, **ablation.variants[variant],
    }  # fmt: skip
    own = [f"--{name}={value}" for name, value in settings.items()]
    if code := subprocess.run([sys.executable, "-m", "league", "run", *own, *flags], check=False).returncode:
        sys.exit(code)  # it has printed the error


def exploited(args: argparse.Namespace, variant: str, seed: int) -> list[dict]:
    """Return the results of attackers against a league's newest snapshots; trained attackers are used again."""
    where = place(args, variant, seed)
    with Store.open(where) as store:
        victims = [s.name for s in LeagueState.of(store, variant).newest_snapshots]
    found = []
    for victim in victims:
        command = [
            sys.executable, "-m", "league", "exploit", victim, "--store", str(where), "--league", variant,
            "--budget", str(args.exploit), "--episodes", str(2 * args.episodes), "--format", "json",
        ]  # fmt: skip
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            sys.exit(done.returncode)  # it has printed the error
        found.append({k: v for k, v in json.loads(done.stdout).items() if k != "lineage"})
    return found


def learning(args: argparse.Namespace, ablation: Ablation, variant: str) -> dict:
    """Summarise a variant's learning curves by seed, with the environment steps at which they reached thresholds."""
    seeds = []
    for seed in args.seeds:
        with Store.open(place(args, variant, seed)) as store:
            state = LeagueState.of(store, variant)
            players = {p.name: store.curves(variant, p.name) for p in state.players}
            seeds.append({
                "seed": seed,
                "steps": {name: points[-1].step for name, points in players.items()},
                "seconds": {name: round(points[-1].seconds, 1) for name, points in players.items()},
                "reached": {name: list(firsts(points, ablation.reached)) for name, points in players.items()},
                "last": {name: means(points) for name, points in players.items()},
                "norms": {s.name: n for s in state.newest_snapshots if (n := norms(store, s))},
                "run": bare(store.runs(variant)[0].config),
            })  # fmt: skip
        if args.exploit:
            seeds[-1]["exploited"] = exploited(args, variant, seed)
    return {"flags": dict(ablation.variants[variant]), "seeds": seeds}


def firsts(points: list[CurvePoint], reached: Mapping[str, tuple[float, ...]]) -> Iterator[dict]:
    """Yield the environment steps after which a figure's mean over WINDOW iterations first reached each threshold."""
    for figure, thresholds in reached.items():
        values = np.array([point.values.get(figure, np.nan) for point in points])
        smooth = np.convolve(np.nan_to_num(values, nan=-np.inf), np.ones(WINDOW) / WINDOW, "valid")
        for threshold in thresholds:
            above = np.flatnonzero(smooth >= threshold)
            steps = points[int(above[0]) + WINDOW - 1].step if len(above) else None
            yield {"figure": figure, "at": threshold, "steps": steps}


def means(points: list[CurvePoint]) -> dict[str, float]:
    """Return mean score, reward, entropy and explained variance of the last WINDOW iterations."""
    names = ("score", "reward", "entropy", "explained_variance")
    found = {name: [p.values[name] for p in points[-WINDOW:] if name in p.values] for name in names}
    return {name: round(float(np.mean(values)), 4) for name, values in found.items() if values}


def norms(store: Store, snapshot: Snapshot) -> dict:
    """Return the spread of the weights of an actor's input layer norm and first layer, also of its last 50 inputs."""
    held = arrays.from_bytes(store.blobs.get(snapshot.digest))
    if "0/trunk.norm.0.weight" not in held:
        return {}
    weight, first = held["0/trunk.norm.0.weight"], held["0/trunk.hidden.0.weight"]
    size = np.abs(first).mean(axis=0)  # (inputs,) mean absolute weight in the first layer
    return {
        "gain": spread(weight),
        "inputs": len(weight),
        "first_layer": spread(size),
        "its_last_50": spread(size[-50:]),
    }


def crossed(args: argparse.Namespace, ablation: Ablation) -> dict:
    """Play all newest snapshots of one team against the other's, or against all others if the teams are equal."""
    first, *_ = product(ablation.variants, args.seeds)
    with Store.open(place(args, *first)) as store:
        config = replace(configuration.loads(store.league(first[0]).config), after=())
    arena = config.arena.build(engine=config.engine, worlds=2)
    if len(arena.teams) != 2:
        return {}
    folder = args.store / args.ablation / "crossed"
    whose: dict[str, tuple[str, str, str]] = {}  # snapshot's name in this store -> variant, seed, roster
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
    """Import a league's newest snapshots into the common store; return name there -> (variant, seed, roster)."""
    found = {}
    with league.open(source) as of, league.open(folder) as into:
        for snapshot in LeagueState.of(of.store, variant).newest_snapshots:
            name = f"{variant}-{seed}-{snapshot.player}"
            if name not in {s.name for s in into.store.snapshots("crossed")}:
                policy_file.bring_in(into, policy_file.export(of, snapshot.name), name)
            found[name] = (variant, str(seed), snapshot.roster)
    return found


def of_variants(table: list[dict], whose: Mapping[str, tuple[str, str, str]]) -> dict[str, dict]:
    """Return mean and spread of the score of each variant against each other, by roster, over all pairs of seeds.

    With several seeds of two variants also the 95 % interval of the mean with seeds drawn again (`low`, `high`).
    """
    found: dict[str, dict[tuple[str, str], list[float]]] = {}
    alike = len({roster for *_, roster in whose.values()}) == 1
    for row in table:
        for a, b, value in ((row["a"], row["b"], row["score"]), (row["b"], row["a"], 1 - row["score"])):
            variant = whose[a][0] if alike else f"{whose[a][0]} ({whose[a][2]})"
            name = f"{variant} against {whose[b][0]}"
            found.setdefault(name, {}).setdefault((whose[a][1], whose[b][1]), []).append(value)
    means = {}
    for name, by_seeds in sorted(found.items()):
        values = [value for each in by_seeds.values() for value in each]
        means[name] = {**spread(values), "mean": round(float(np.mean(values)), 4), "pairs": len(values)}
        means[name] |= seeds_drawn_again(by_seeds)
    return means


def seeds_drawn_again(scores: Mapping[tuple[str, str], list[float]]) -> dict[str, float]:
    """Return the 95 % interval of the mean score when the seeds of either side are drawn again (bootstrap).

    Nothing with one seed of a side, or without a pair of seeds, as where a variant meets itself.
    """
    firsts, seconds = (sorted({pair[side] for pair in scores}) for side in (0, 1))
    if min(len(firsts), len(seconds)) < 2 or len(scores) < len(firsts) * len(seconds):
        return {}
    table = np.array([[np.mean(scores[a, b]) for b in seconds] for a in firsts])
    rng = np.random.default_rng(0)
    rows = rng.integers(len(firsts), size=(SAMPLES, len(firsts), 1))
    columns = rng.integers(len(seconds), size=(SAMPLES, 1, len(seconds)))
    low, high = np.percentile(table[rows, columns].mean(axis=(1, 2)), (2.5, 97.5))
    return {"low": round(float(low), 4), "high": round(float(high), 4)}


if __name__ == "__main__":
    main()
