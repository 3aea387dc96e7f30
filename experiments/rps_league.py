"""Rock, paper, scissors in real leagues: opponent rules that find the uniform mixture, and rules that run in circles.

    python -m experiments.rps_league [--rules latest uniform nash] [--seeds 1 2] [--entropy 0.1] [--every STEPS]
        [--anew] [--out FILE.json]
    python -m experiments.rps_league --exact

For each rule and seed a league is run; then the choices of every snapshot are computed from its Gaussian. The result
has for each player the distance (total variation, 0 to 2/3) to one third each: of the mean over its history, of the
average policy, of the Nash mixture of its snapshots and of its newest snapshot; also the mean distance of its
snapshots, and how often they circled the centre. The Nash mixture is solved on the exact payoffs of the snapshots'
choices.

Fictitious play converges in the average policy, in which each iteration has the same weight (Robinson 1951), if
opponents are sampled in the same way. A league's older snapshots lie closer together, so the plain mean of snapshots,
which is what opponents meet, is a different mixture; with --every, players are frozen at equal distances, and the two
are the same. The average weights each snapshot by the iterations until the next one. It is given at each quarter of the
history, and so is its exploitability, the gain of a best response against it, 0 to 1.

With --anew, a player restarts from its first policy after each snapshot, so that each snapshot is a response only to
those before it. With --exact, no league is run: two softmax policies follow the exact gradient against the mean of each
other's history, which shows the effect of the rule on a continuing learner and on one that restarts.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from agents.policy.jax_policy import distribution
from arenas import settings
from league.snapshots.codec import thaw
from matchmaking.metagame.nash import nash
from scripts.record import make_parser, run_info, write
from storage.store import Store

RPS = np.array([[0.0, -1, 1], [1, 0, -1], [-1, 1, 0]])
SETTINGS = (
    "--training.worlds", "128", "--training.rollout_length", "8", "--training.iterations_per_turn", "2",
    "--training.snapshots-per-doubling", "16", "--learner.lr", "5e-3", "--learner.critic-lr", "5e-3",
    "--learner.architecture.hidden", "8", "--rating.share", "0.3",
    "--rating.record", "false", "--rating.trained", "false",
)  # fmt: skip


def run(folder: Path, rule: str, seed: int, args: argparse.Namespace) -> None:
    """Run a league from its start to its end."""
    reset = ', reset = "initial"' if args.anew else ""
    evenly = () if args.every is None else ("--roles", f'[{{name = "main", timeout = {args.every}{reset}}}]')
    subprocess.run(
        [
            sys.executable, "-m", "league", "run", "--arena.name", "rock-paper-scissors", "--store", str(folder),
            "--seed", str(seed), "--steps", str(args.steps), "--budget.rating_time", "0s",
            "--learner.entropy_coef", str(args.entropy), "--training.opponents.kind", rule, *SETTINGS, *evenly,
        ],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip


def exact(anew: bool, seed: int, steps: int = 4000, size: float = 0.15, period: int = 16) -> list[float]:
    """Return the distance of both histories' means to one third each, for noise-free learners of three logits.

    Args:
        anew: restart from the first policy after each snapshot.
        seed: of the first policies.
        steps: number of gradient steps on the logits.
        size: of a step.
        period: steps between two snapshots.
    """
    logits = np.random.default_rng(seed).normal(scale=0.1, size=(2, 3))
    first, histories = logits.copy(), ([], [])
    for step in range(steps):
        if step % period == 0:
            for own, history in zip(logits, histories, strict=True):
                history.append(np.exp(own - own.max()) / np.exp(own - own.max()).sum())
            logits = first.copy() if anew else logits
        met = [np.mean(history, axis=0) for history in reversed(histories)]
        logits = logits + size * np.array([RPS @ mixture for mixture in met])
    return [_far(np.mean(history, axis=0)) for history in histories]


def choices(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return each player's frequencies of rock, paper and scissors (snapshots, 3), oldest first, and iterations."""
    arena, rng, found = settings("rock-paper-scissors").build(), np.random.default_rng(0), {}
    noise = rng.normal(size=(20_000, 3))
    with Store.open(folder) as store:
        (league,) = store.leagues()
        for player in store.players(league.name):
            rows = []
            history = store.snapshots(league.name, player.name)
            for snapshot in history:
                mean, std = map(np.asarray, distribution(thaw(store, snapshot, arena)[0], np.ones((1, 1))))  # type: ignore
                rows.append(np.bincount((mean + std * noise).argmax(1), minlength=3) / len(noise))
            found[player.name] = np.array(rows), np.array([s.iteration for s in history])
    return found


def figures(rows: np.ndarray, iterations: np.ndarray, others: np.ndarray) -> dict[str, Any]:
    """Compute the figures of a player's snapshots, see the module's docstring."""
    corners = np.exp(2j * np.pi * np.arange(3) / 3)
    steps = np.diff(np.unwrap(np.angle(rows @ corners)))
    mixed = nash(rows @ RPS @ others.T).mass @ rows
    averages = [average(rows, iterations, share * iterations[-1]) for share in (0.25, 0.5, 0.75, 1.0)]
    return {
        "snapshots": len(rows), "history": _far(rows.mean(0)), "average": [_far(each) for each in averages],
        "exploitability": [round(float((RPS @ each).max()), 3) for each in averages],
        "nash": _far(mixed), "newest": _far(rows[-1]),
        "mean_distance": round(float(np.mean([_far(row) for row in rows[len(rows) // 2 :]])), 3),
        "rounds": round(float(steps.sum() / (2 * np.pi)), 2), "newest_choices": rows[-1].round(3).tolist(),
    }  # fmt: skip


def average(rows: np.ndarray, iterations: np.ndarray, until: float) -> np.ndarray:
    """Return the average policy (3,) of the iterations `until` then, each weighted as the snapshot before it."""
    ends = np.minimum(np.append(iterations[1:], iterations[-1]), until)
    weights = np.maximum(ends - iterations, 0)
    return weights @ rows / weights.sum()


def _far(mixture: np.ndarray) -> float:
    """Return the total variation distance to one third each."""
    return round(float(np.abs(mixture - 1 / 3).sum() / 2), 3)


def main() -> None:
    """Run all leagues and write the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--rules", nargs="+", default=["latest", "uniform", "nash"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--entropy", type=float, default=0.1)
    parser.add_argument("--every", type=int, metavar="STEPS")
    parser.add_argument("--anew", action="store_true", help="restart after each snapshot, with --every")
    parser.add_argument("--exact", action="store_true", help="learners without noise instead of leagues")
    args = parser.parse_args()
    if args.exact:
        for anew in (False, True):
            print("restarts" if anew else "continues", [exact(anew, seed) for seed in args.seeds])
        return
    found: dict[str, Any] = {
        "steps": args.steps,
        "entropy": args.entropy,
        "every": args.every,
        "anew": args.anew,
        "settings": " ".join(SETTINGS),
        "leagues": [],
    }
    for rule in args.rules:
        for seed in args.seeds:
            with tempfile.TemporaryDirectory() as place:
                run(Path(place), rule, seed, args)
                rows = choices(Path(place))
            for player, other in (("blue", "red"), ("red", "blue")):
                row = {"rule": rule, "seed": seed, "player": player, **figures(*rows[player], rows[other][0])}
                print(json.dumps(row), flush=True)
                found["leagues"].append(row)
    if args.out:
        write({**run_info(args.commit), **found}, args.out)


if __name__ == "__main__":
    main()
