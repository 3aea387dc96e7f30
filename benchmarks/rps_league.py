"""Rock, paper, scissors through the real daemon: which rules for opponents find the even mixture, and which run in
circles.

    python benchmarks/rps_league.py [--rules latest uniform nash] [--seeds 1 2] [--entropy 0.1] [--every STEPS]
        [--anew] [--out FILE.json]
    python benchmarks/rps_league.py --exact

For each rule and seed a league is run; then every snapshot's choices are computed from its Gaussian. Told are, for each
player: how far (total variation, 0 to 2/3) the mean over its history, the average policy, the Nash mixture of its
snapshots and its newest snapshot are from one third each, the mean distance of the snapshots, and how often they went
round the middle. The Nash mixture is solved on the exact payoffs of the snapshots' choices.

Fictitious play converges in the average policy, in which each iteration counts alike (Robinson 1951), where that is
also what is met. On the league's axis snapshots lie closer together the older they are, so the mixture that is met, the
plain mean, is another one; with --every players are frozen every so many steps, and the two are the same. The average
counts each snapshot for the iterations until the next one; it is told at each quarter of the history, and so is what a
best response gains against it, 0 to 1: its exploitability.

With --anew a player begins from its first policy after each snapshot, so that each snapshot is an answer to those
before it alone. With --exact no league is run: two softmax policies follow the exact gradient against the mean of each
other's history, which shows what the rule does to a learner that goes on and to one that begins anew.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path[0] = str(Path(__file__).parents[1])  # this folder has an arenas.py too

from agents.policy import distribution  # noqa: E402
from arenas import settings  # noqa: E402
from league.policies import thaw  # noqa: E402
from matchmaking.equilibrium import nash  # noqa: E402
from storage.store import Store  # noqa: E402

RPS = np.array([[0.0, -1, 1], [1, 0, -1], [-1, 1, 0]])
SETTINGS = (
    "--training.worlds", "128", "--training.rollout", "8", "--training.turn", "2",
    "--training.snapshots-per-doubling", "16", "--learner.lr", "5e-3", "--learner.critic-lr", "5e-3",
    "--learner.architecture.hidden", "8", "--rating.share", "0.3",
    "--rating.record", "false", "--rating.trained", "false",
)  # fmt: skip


def run(folder: Path, rule: str, seed: int, asked: argparse.Namespace) -> None:
    """A league from its start to its end."""
    reset = ', reset = "initial"' if asked.anew else ""
    evenly = () if asked.every is None else ("--roles", f'[{{name = "main", timeout = {asked.every}{reset}}}]')
    subprocess.run(
        [
            sys.executable, "-m", "league", "run", "--arena.name", "rock-paper-scissors", "--store", str(folder),
            "--seed", str(seed), "--steps", str(asked.steps), "--budget.rate", "0s",
            "--learner.entropy", str(asked.entropy), "--training.opponents.kind", rule, *SETTINGS, *evenly,
        ],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip


def exact(anew: bool, seed: int, steps: int = 4000, size: float = 0.15, life: int = 16) -> list[float]:
    """How far the means of both histories are from one third each, of learners of three logits without any noise.

    Args:
        anew: begin from the first policy after each snapshot.
        seed: of the first policies.
        steps: along the gradient, in logits.
        size: of a step.
        life: steps between two snapshots.
    """
    logits = np.random.default_rng(seed).normal(scale=0.1, size=(2, 3))
    first, histories = logits.copy(), ([], [])
    for step in range(steps):
        if step % life == 0:
            for own, history in zip(logits, histories, strict=True):
                history.append(np.exp(own - own.max()) / np.exp(own - own.max()).sum())
            logits = first.copy() if anew else logits
        met = [np.mean(history, axis=0) for history in reversed(histories)]
        logits = logits + size * np.array([RPS @ mixture for mixture in met])
    return [_far(np.mean(history, axis=0)) for history in histories]


def choices(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """(snapshots, 3) How often each snapshot of a player chooses rock, paper and scissors, oldest first.

    And (snapshots,) at which iterations they were frozen.
    """
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


def told(rows: np.ndarray, iterations: np.ndarray, others: np.ndarray) -> dict[str, Any]:
    """A player's snapshots in figures."""
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
    """(3,) The average policy of the iterations until then, each played as the snapshot before it."""
    ends = np.minimum(np.append(iterations[1:], iterations[-1]), until)
    weights = np.maximum(ends - iterations, 0)
    return weights @ rows / weights.sum()


def _far(mixture: np.ndarray) -> float:
    """Total variation from one third each."""
    return round(float(np.abs(mixture - 1 / 3).sum() / 2), 3)


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    options.add_argument("--rules", nargs="+", default=["latest", "uniform", "nash"])
    options.add_argument("--seeds", nargs="+", type=int, default=[1, 2])
    options.add_argument("--steps", type=int, default=150_000)
    options.add_argument("--entropy", type=float, default=0.1)
    options.add_argument("--every", type=int, metavar="STEPS")
    options.add_argument("--anew", action="store_true", help="after each snapshot, with --every")
    options.add_argument("--exact", action="store_true", help="learners without noise instead of leagues")
    options.add_argument("--out", type=Path)
    asked = options.parse_args()
    if asked.exact:
        for anew in (False, True):
            print("begins anew" if anew else "goes on", [exact(anew, seed) for seed in asked.seeds])
        return
    found: dict[str, Any] = {
        "steps": asked.steps,
        "entropy": asked.entropy,
        "every": asked.every,
        "anew": asked.anew,
        "settings": " ".join(SETTINGS),
        "leagues": [],
    }
    for rule in asked.rules:
        for seed in asked.seeds:
            with tempfile.TemporaryDirectory() as place:
                run(Path(place), rule, seed, asked)
                rows = choices(Path(place))
            for player, other in (("blue", "red"), ("red", "blue")):
                row = {"rule": rule, "seed": seed, "player": player, **told(*rows[player], rows[other][0])}
                print(json.dumps(row), flush=True)
                found["leagues"].append(row)
    if asked.out:
        asked.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
