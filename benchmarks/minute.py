"""A minute of training in each arena: does it run, how fast, and how many episodes are void. Prints a line for each.

    python benchmarks/minute.py --out benchmarks/results/minute-cpu.json
    python benchmarks/minute.py soccer-1v1 galaga-2v2 --for 5m --out five.json -- --training.worlds 128

Each is a league of its own by `league run` with the default learner, whose store is gone afterwards; what stands after
`--` goes to that command too. Voids are counted as the learners count them, over all worlds of training, and as the
match log has them. An arena fails, and the command with it, where the share of void episodes is above `--limit`.
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

import arenas  # noqa: E402
import league  # noqa: E402
from benchmarks.record import commit, machine  # noqa: E402
from league.versions import versions  # noqa: E402

RATED = "15s"  # of rating after it


def main() -> int:
    """Train in each arena, print and write what was seen; 1 where one of them voided too much."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("arenas", nargs="*", metavar="ARENA", help="default: all that come with the league")
    parser.add_argument("--for", dest="duration", default="60s", help="of training, compiling apart")
    parser.add_argument("--limit", type=float, default=0.01, help="the largest share of void episodes that is fine")
    parser.add_argument("--out", type=Path)
    args, flags = parser.parse_known_args()
    flags = [flag for flag in flags if flag != "--"]
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": commit(), "machine": machine(), "versions": versions(),
        "arenas": [],
    }  # fmt: skip
    for name in args.arenas or arenas.names():
        with tempfile.TemporaryDirectory() as folder:
            found = train(name, args.duration, flags, Path(folder, "store"))
        print(json.dumps(found), flush=True)
        result["arenas"].append(found)
        if args.out:
            args.out.write_text(json.dumps(result, indent=1) + "\n")
    return int(any(each["void_share"] > args.limit for each in result["arenas"]))


def train(name: str, duration: str, flags: list[str], store: Path) -> dict:
    """Run a league of one arena, and tell what its players say of it."""
    told = ["--arena.name", name, "--league", "minute", "--for", duration, "--budget.rate", RATED]
    subprocess.run(
        [sys.executable, "-m", "league", "run", "--store", str(store), *told, *flags],
        cwd=sys.path[0], check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    with league.open(store) as opened:
        curves, matches, frozen = opened.curves(), opened.matches(), opened.snapshots()
    last = curves.groupby("player").last()
    episodes, voids = curves.groupby("player")[["episodes", "voids"]].sum().max()
    return {
        "arena": name,
        "seconds": round(float(last.seconds.max()), 1),
        "decisions": int(last.steps.max()),
        "iterations": int(last.iteration.max()),
        "decisions_per_second": round(float(last.steps.max() / last.seconds.max())),
        "episodes": int(episodes),
        "voids": int(voids),
        "void_share": round(float(voids / max(episodes + voids, 1)), 5),
        "rated_episodes": int(matches[["wins", "draws", "losses"]].to_numpy().sum()) if len(matches) else 0,
        "rated_voids": int(matches.voids.sum()) if len(matches) else 0,
        "snapshots": len(frozen),
    }


if __name__ == "__main__":
    sys.exit(main())
