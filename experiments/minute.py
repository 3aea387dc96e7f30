"""A minute of training in each arena: it runs, how fast, and the share of void episodes. Prints a line for each.

    python -m experiments.minute --out experiments/results/minute-cpu.json
    python -m experiments.minute soccer-1v1 galaga-2v2 --for 5m --out five.json -- --training.worlds 128

Each arena has a league of its own by `league run` with the default learner, whose store is deleted afterwards;
arguments after `--` are further flags of `league run`. Voids are counted by the learners, over all worlds of training,
and by the match log. An arena fails, and with it the command, if its share of void episodes is above `--limit`.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from league.system.environment import prepare

prepare()  # before jax reads the environment

import arenas
import league
from scripts.record import make_parser, run_info, split_arguments, write

RATED = "15s"  # of rating afterwards


def main() -> int:
    """Train in each arena, print and write the figures; return 1 if one has too many voids."""
    parser = make_parser(__doc__)
    parser.add_argument("arenas", nargs="*", metavar="ARENA", help="default: all that come with the league")
    parser.add_argument("--for", dest="duration", default="60s", help="of training, without compilation")
    parser.add_argument("--limit", type=float, default=0.01, help="largest accepted share of void episodes")
    own, flags = split_arguments(sys.argv[1:])
    args = parser.parse_args(own)
    result = {**run_info(args.commit), "arenas": []}
    for name in args.arenas or arenas.names():
        with tempfile.TemporaryDirectory() as folder:
            found = train(name, args.duration, flags, Path(folder, "store"))
        print(json.dumps(found), flush=True)
        result["arenas"].append(found)
        write(result, args.out)
    return int(any(each["void_share"] > args.limit for each in result["arenas"]))


def train(name: str, duration: str, flags: list[str], store: Path) -> dict:
    """Run a league of one arena and return its figures."""
    settings = ["--arena.name", name, "--league", "minute", "--for", duration, "--budget.rating_time", RATED]
    subprocess.run(
        [sys.executable, "-m", "league", "run", "--store", str(store), *settings, *flags],
        check=True, stdout=subprocess.DEVNULL,
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
