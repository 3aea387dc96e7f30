"""Weak scaling: training of a league over several devices, with the same number of worlds on each.

    python -m benchmarks.scaling --devices 1 2 4 --worlds 8192 --out benchmarks/results/scaling-h200.json
    python -m benchmarks.scaling --devices 1 2 --worlds 64 --seconds 20 --arena sumo-1v1 -- --training.device cpu

A round runs a league for each number of devices, one after the other, with nothing else on them; arguments after `--`
are further flags of `league run`. Speeds are decisions/s of all worlds together, learning included, between the first
learning iteration after `--warm` seconds of training and the last one: `in_turns` by the learning curve, which counts
time within turns, and `all_told` by the dates of checkpoints in the store, which count all time. A ratio is the speed
per device over the speed of one device in the same round. On a CPU, where processes share the cores, a ratio says
nothing about the program. Prints and writes JSON.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from league.system.environment import prepare

prepare()  # before jax reads the environment

from scripts.record import make_parser, run_info, spread, write
from storage.records import Checkpoint, CurvePoint
from storage.store import Store

LEAGUE = "scaling"
ASKED = {4: 0.92}


def main() -> None:
    """Measure, and write the JSON after each round."""
    args = arguments()
    rounds: list[dict[int, dict]] = []
    for _ in range(args.rounds):
        rounds.append({})
        for devices in args.devices:
            rounds[-1][devices] = of_league(args, devices)
            print(json.dumps({"devices": devices, **rounds[-1][devices]}), flush=True)
        rows = [row(args, rounds, devices) for devices in args.devices]
        print(json.dumps(rows, indent=1), flush=True)
        if args.out:
            write({**run_info(args.commit), "rows": rows, "rounds": rounds}, args.out)


def arguments() -> argparse.Namespace:
    """Parse the command line; one device is always among the devices."""
    parser = make_parser(__doc__)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--worlds", type=int, default=8192, help="on each device")
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--seconds", type=int, default=60, help="of training in each league")
    parser.add_argument("--warm", type=float, default=15.0, help="of these seconds, the first that are not counted")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("flags", nargs="*", help="further flags of `league run`, after --")
    args = parser.parse_args()
    args.devices = sorted({1, *args.devices})
    return args


def of_league(args: argparse.Namespace, devices: int) -> dict:
    """Run a league on this number of devices and read its speed from its store."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder, "store")
        command = [
            sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE,
            "--arena.name", args.arena, "--training.devices", str(devices),
            "--training.worlds", str(devices * args.worlds),
            "--for", f"{args.seconds}s", "--budget.rating_time", "0s", "--workers.match", "0", *args.flags,
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            sys.exit(f"the league of {devices} devices failed:\n{done.stdout}{done.stderr}")
        with Store.open(where) as store:
            player = store.players(LEAGUE)[0].name
            points = [p for p in store.curves(LEAGUE, player) if p.seconds >= args.warm]
            kept = [c for c in store.checkpoints(LEAGUE) if c.player == player and c.seconds >= args.warm]
            failed = [job.error for job in store.jobs(LEAGUE) if job.failures]
    if failed:
        sys.exit(f"a turn of {devices} devices failed: {failed[0]}")
    if len(points) < 2:
        sys.exit(f"{args.seconds} s were too few for two iterations after {args.warm} s; give more --seconds")
    return {
        "worlds": devices * args.worlds, "iterations": len(points) - 1,
        "in_turns": round(speed(points[0], points[-1], points[-1].seconds - points[0].seconds)),
        "all_told": round(speed(kept[0], kept[-1], kept[-1].created - kept[0].created)) if len(kept) > 1 else None,
    }  # fmt: skip


def speed(first: CurvePoint | Checkpoint, last: CurvePoint | Checkpoint, seconds: float) -> float:
    """Return decisions/s between two points."""
    return (last.step - first.step) / seconds


def row(args: argparse.Namespace, rounds: list[dict[int, dict]], devices: int) -> dict:
    """Return the speeds of all rounds on this number of devices, and their ratios."""
    found: dict = {"devices": devices, "arena": args.arena, "worlds": devices * args.worlds}
    for name in ("in_turns", "all_told"):
        pairs = [(each[devices][name], each[1][name]) for each in rounds if each[devices][name] and each[1][name]]
        if pairs:
            found[f"decisions_per_second_{name}"] = spread([own for own, _ in pairs], 0)
            found[f"ratio_{name}"] = spread([own / (devices * one) for own, one in pairs])
    return found | ({"target": f"at least {ASKED[devices]}"} if devices in ASKED else {})


if __name__ == "__main__":
    main()
