"""Weak scaling: a league's turns spread over several devices, each with as many worlds. Prints and writes JSON.

    python benchmarks/scaling.py --devices 1 2 4 --worlds 8192 --out benchmarks/results/scaling-h200.json
    python benchmarks/scaling.py --devices 1 2 --worlds 64 --seconds 20 --arena sumo-1v1 -- --training.device cpu

A round runs a league for each number of devices, one after the other, with nothing else on them; what follows `--` are
further flags of `league run`. Speeds are decisions/s of all worlds together, learning included, between the first
learning iteration after `--warm` seconds of training and the last: by the learning curve, which counts time within
turns, and by the store's dates of checkpoints, which count all. A ratio is a league's speed for each of its devices
over that of one device in the same round; on a CPU, where processes share the cores, it says nothing of the program.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

from benchmarks.record import commit, machine, spread  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.records import Checkpoint, CurvePoint  # noqa: E402
from storage.store import Store  # noqa: E402

LEAGUE = "scaling"
ASKED = {4: 0.92}


def main() -> None:
    """Measure, and write the JSON after each round."""
    args = arguments()
    about = {"command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "versions": versions()}
    rounds: list[dict[int, dict]] = []
    for _ in range(args.rounds):
        rounds.append({})
        for devices in args.devices:
            rounds[-1][devices] = of_league(args, devices)
            print(json.dumps({"devices": devices, **rounds[-1][devices]}), flush=True)
        result = {**about, "rows": [row(args, rounds, devices) for devices in args.devices]}
        print(json.dumps(result["rows"], indent=1), flush=True)
        if args.out:
            args.out.write_text(json.dumps({**result, "machine": machine(), "rounds": rounds}, indent=1) + "\n")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--worlds", type=int, default=8192, help="of each device")
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--seconds", type=int, default=60, help="of training in each league")
    parser.add_argument("--warm", type=float, default=15.0, help="of them, not counted")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("--out", type=Path)
    parser.add_argument("flags", nargs="*", help="further flags of `league run`, after --")
    args = parser.parse_args()
    args.devices = sorted({1, *args.devices})
    return args


def of_league(args: argparse.Namespace, devices: int) -> dict:
    """Run a league over so many devices and read its speed off its store."""
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder, "store")
        command = [
            sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE,
            "--arena.name", args.arena, "--training.devices", str(devices),
            "--training.worlds", str(devices * args.worlds),
            "--for", f"{args.seconds}s", "--budget.rate", "0s", "--workers.match", "0", *args.flags,
        ]  # fmt: skip
        done = subprocess.run(command, cwd=sys.path[0], capture_output=True, text=True, check=False)
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
    return (last.step - first.step) / seconds


def row(args: argparse.Namespace, rounds: list[dict[int, dict]], devices: int) -> dict:
    """The rounds' speeds over so many devices, and their ratios."""
    found: dict = {"devices": devices, "arena": args.arena, "worlds": devices * args.worlds}
    for name in ("in_turns", "all_told"):
        pairs = [(each[devices][name], each[1][name]) for each in rounds if each[devices][name] and each[1][name]]
        if pairs:
            found[f"decisions_per_second_{name}"] = spread([own for own, _ in pairs], 0)
            found[f"ratio_{name}"] = spread([own / (devices * one) for own, one in pairs])
    return found | ({"target": f"at least {ASKED[devices]}"} if devices in ASKED else {})


if __name__ == "__main__":
    main()
