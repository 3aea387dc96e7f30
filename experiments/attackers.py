"""Gains of attackers against robots that learnt against the newest opponents, against a history, and with a magnet.

    python -m experiments.attackers sumo-2v2 --steps 100_000_000 --more '{"training.worlds": 4096}' --out ...
    python -m experiments.attackers sumo-1v1 --steps 200_000 --victims latest magnet --times 1 --attackers 1

Each victim is the newest snapshot of blue, after a league of two players with equal settings, steps and distances
between snapshots:

- `latest`: against the opponents as they are now;
- `history`: against a uniform history;
- `magnet`: as `latest`, with `learner.magnet_coef` of `--magnet` (and `--magnet-updates`);
- `both`: against a uniform history, with the magnet.

Then `league exploit` trains attackers against it, without a magnet: from scratch and from the victim's own networks,
with seeds 1 to `--attackers`, for each of `--times` as many steps as the victim had. An attacker with more steps is the
same one that learns on. All play `--episodes`. The one that scores most plays `--fresh` further episodes, other games,
so that its score and interval are not those of the luckiest: `bound` is that score less ½, a lower bound of
exploitability.

Leagues and attackers that the file of results has are not run again, and with `--store` those of a run that was killed
continue.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import league
from league.matches.adhoc_matches import pairing
from league.matches.exploitability import finding, measure
from league.queries.query import Open
from scripts.record import make_parser, run_info, write
from storage.store import Store

VICTIMS = ("latest", "history", "magnet", "both")
STARTS = ("scratch", "victim")
SETTINGS: dict[str, Any] = {
    "training.record_every": 0, "workers.match": 0, "budget.rating_time": "0s", "rating.scripts": [],
    "rating.trained": False, "rating.record": False,
}  # fmt: skip


def settings_of(victim: str, args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings of a victim's league that differ from those of others."""
    pulled = {"learner.magnet_coef": args.magnet, "learner.magnet_updates": args.magnet_updates}
    return {
        "training.opponents.kind": "uniform" if victim in ("history", "both") else "latest",
        **(pulled if victim in ("magnet", "both") else {}),
    }


def train(victim: str, seed: int, store: str, args: argparse.Namespace) -> dict[str, Any]:
    """Run the league of a victim, or continue it; return what its blue player became."""
    name = f"{victim}-{seed}"
    own = {
        **SETTINGS, "arena.name": args.arena, "seed": seed, "league": name, "budget.steps": args.steps,
        "roles": [{"name": "main", "timeout": max(1, args.steps // args.snapshots)}], **settings_of(victim, args),
        **args.more,
    }  # fmt: skip
    begun = time.monotonic()
    opened = league.run({}, store=store, progress=False, **own)
    try:
        newest = opened.store.snapshots(name, "blue")[-1]
        return {
            "victim": victim,
            "seed": seed,
            "league": name,
            "snapshot": newest.name,
            "steps": newest.step,
            "train_seconds": round(newest.seconds, 1),
            "wall_seconds": round(time.monotonic() - begun, 1),
        }
    finally:
        opened.store.close()


def attacked(row: dict[str, Any], store: str, start: str, seed: int, steps: int, episodes: int) -> dict[str, Any]:
    """Train an attacker for so many steps in all, unless it has had them, and return its score.

    Raises SystemExit with the last line of what the command said if it fails.
    """
    asked = (
        "exploit", row["snapshot"], "--league", row["league"], "--store", store, "--budget", str(steps),
        "--start", start, "--seed", str(seed), "--episodes", str(episodes), "--format", "json",
    )  # fmt: skip
    done = subprocess.run([sys.executable, "-m", "league", *asked], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"league {' '.join(asked)}: {(done.stderr.strip() or 'it failed').splitlines()[-1]}")
    found = json.loads(done.stdout)
    kept = ("attacker", "steps", "seconds", "episodes", "score", "score_low", "score_high")
    return {"start": start, "seed": seed, "asked_steps": steps, **{name: found[name] for name in kept}}


def attack_all(row: dict[str, Any], store: str, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the row of a victim after each attack, the last time with the bound that its best attacker sets."""
    attacks: list[dict[str, Any]] = []
    for times in sorted(args.times):
        for start in args.starts:
            for seed in range(1, args.attackers + 1):
                found = attacked(row, store, start, seed, round(times * args.steps), args.episodes)
                attacks.append({"times": times, **found})
                yield {**row, "attacks": attacks}
    best = max(attacks, key=lambda each: each["score"])
    yield {**row, "attacks": attacks, "best": best, "bound": bound(row, store, best["attacker"], args.fresh)}


def bound(row: dict[str, Any], store: str, attacker: str, episodes: int) -> dict[str, Any]:
    """Return the score less ½ of an attacker in so many episodes that it has not played yet, with its 95 % interval."""
    with Store.open(store) as kept:
        found = pairing(Open(kept, row["league"]), attacker, row["snapshot"])
        took = finding(found, measure(found, episodes))
    value, low, high = (round(each, 4) for each in took.over)
    return {"attacker": attacker, "episodes": took.score.games, "value": value, "low": low, "high": high}


def parsed() -> argparse.Namespace:
    """Return the arguments. Exits with code 2 for numbers that cannot be."""
    parser = make_parser(__doc__)
    parser.add_argument("arena", help="of two equal teams, e.g. sumo-2v2")
    parser.add_argument("--steps", type=int, required=True, help="environment steps of each victim's league")
    parser.add_argument("--victims", nargs="+", default=["latest", "magnet", "history"], choices=VICTIMS)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3], help="of the victims' leagues")
    parser.add_argument("--attackers", type=int, default=2, help="seeds of attackers of each start")
    parser.add_argument("--times", nargs="+", type=float, default=[1.0, 3.0], help="an attacker's steps / the victim's")
    parser.add_argument("--starts", nargs="+", default=list(STARTS), choices=STARTS)
    parser.add_argument("--magnet", type=float, default=0.05, help="learner.magnet_coef")
    parser.add_argument("--magnet-updates", type=int, default=0, help="learner.magnet_updates")
    parser.add_argument("--snapshots", type=int, default=20, help="snapshots of each league, about")
    parser.add_argument("--episodes", type=int, default=512, help="of each attacker, even")
    parser.add_argument(
        "--fresh", type=int, default=4096, help="further ones of the best attacker, even, and another number"
    )
    parser.add_argument("--store", type=Path, help="keep the leagues here (default: a folder that is removed)")
    parser.add_argument("--more", type=json.loads, default={}, help="further settings of the leagues, as JSON")
    args = parser.parse_args()
    if args.fresh == args.episodes or args.fresh % 2 or args.episodes % 2:
        parser.error("--fresh and --episodes: give two different even numbers, since games are drawn by their number")
    return args


@contextmanager
def storage(path: Path | None) -> Iterator[str]:
    """Give the place of the leagues: this one, or a folder that is removed afterwards."""
    if path is not None:
        yield str(path)
        return
    with tempfile.TemporaryDirectory() as store:
        yield store


def main() -> None:
    """Train the victims and attackers that the file of results does not have yet, and write it after each."""
    args = parsed()
    about = {name: getattr(args, name) for name in ("arena", "steps", "magnet", "magnet_updates", "more")}
    rows: dict[tuple[str, int], dict[str, Any]] = {}
    if args.out and args.out.exists():
        rows = {(row["victim"], row["seed"]): row for row in json.loads(args.out.read_text())["victims"]}
    with storage(args.store) as store:
        for key in product(args.victims, args.seeds):
            if "bound" in rows.get(key, {}):
                continue
            for row in attack_all(train(*key, store, args), store, args):
                rows[key] = row
                if args.out:
                    found = {**about, "settings": SETTINGS, "victims": [*rows.values()]}
                    write({**run_info(args.commit), **found}, args.out)
                shown = {"bound": row["bound"]} if "bound" in row else row["attacks"][-1]
                print(json.dumps({"victim": key[0], "seed": key[1], **shown}), flush=True)


if __name__ == "__main__":
    main()
