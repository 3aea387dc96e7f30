"""Cost of rating matches for training on the same GPU, and the games per second that they reach.

    python -m benchmarks.sharing --out benchmarks/results/sharing-h100.json

Runs a league twice with nothing else on the GPU: `alone`, without matches, and then `with` matches, each in processes
of its own; arguments after `--` are further flags of `league run`. Speeds are steps/s of training, learning included,
by the learning curve, in windows of 30 s of training time; with matches, only windows that begin after the first
matches count. `share` is the share of the last 30 s that the evaluator reports, read twice a second. Games per second
of a device are those of all batches for which time was booked. The file keeps the result of an earlier run; `--again`
repeats both. Prints and writes JSON.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from league.system.environment import prepare

prepare()  # before jax reads the environment

from scripts.record import make_parser, run_info, split_arguments, spread, write
from storage.errors import StorageError
from storage.records import CurvePoint
from storage.store import Store

LEAGUE = "sharing"
WINDOW = 30.0
ASKED = {"training_with_of_alone": "at least 0.85 in every window", "games_per_device_second": "at least 210"}


def main() -> None:
    """Measure, and write the JSON after each run."""
    parser = make_parser(__doc__)
    parser.add_argument("--arena", default="sumo-within-team")
    parser.add_argument("--worlds", type=int, default=8192, help="of training")
    parser.add_argument("--alone", type=int, default=60, help="seconds of training without matches")
    parser.add_argument("--with", type=int, default=230, dest="beside", help="seconds of training with them")
    parser.add_argument("--warm", type=float, default=8.0, help="seconds of training that are not counted")
    parser.add_argument("--again", action="store_true", help="repeat runs whose results are in the file")
    own, further = split_arguments(sys.argv[1:])
    args = parser.parse_args(own, argparse.Namespace(flags=further))
    runs: dict[str, dict] = {}
    if args.out and args.out.exists() and not args.again:
        runs = json.loads(args.out.read_text())["runs"]
    for name, seconds, flags in (("alone", args.alone, ["--workers.match", "0"]), ("with", args.beside, [])):
        if name not in runs:
            runs[name] = league(args, seconds, flags)
            print(json.dumps({name: {k: v for k, v in runs[name].items() if k != "samples"}}, indent=1), flush=True)
        result = summary(args, runs)
        write(result, args.out)
    print(json.dumps({k: v for k, v in result.items() if k not in ("runs", "versions")}, indent=1))


def summary(args: argparse.Namespace, runs: dict[str, dict]) -> dict:
    """Return the whole result, with the ratio once both runs are complete."""
    about = {**run_info(args.commit), "arena": args.arena, "worlds": args.worlds, "asked": ASKED, "runs": runs}
    if len(runs) == 2 and all(run["steps_per_second"] for run in runs.values()):
        alone = runs["alone"]["steps_per_second"]["median"]
        about["training_with_of_alone"] = {k: round(v / alone, 3) for k, v in runs["with"]["steps_per_second"].items()}
        about["games_per_device_second"] = runs["with"]["games_per_device_second"]
        about["share_of_30_s"] = runs["with"]["share"]
    return about


def league(args: argparse.Namespace, seconds: int, flags: list[str]) -> dict:
    """Run a league for `seconds` of training, sample its status twice a second, and read its figures from its store."""
    with tempfile.TemporaryDirectory() as folder:
        where, began = Path(folder, "store"), time.monotonic()
        command = [
            sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE, "--arena.name",
            args.arena, "--training.worlds", str(args.worlds), "--for", f"{seconds}s", "--budget.rating_time", "0s",
            *flags, *args.flags,
        ]  # fmt: skip
        with Path(folder, "out.txt").open("w+") as out:
            process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT)
            samples = sampled(process, where)
            out.seek(0)
            output = out.read()
        if process.returncode:
            sys.exit(f"the league failed:\n{output}")
        with Store.open(where) as store:
            player = store.players(LEAGUE)[0].name
            points = store.curves(LEAGUE, player)
            (took, _), episodes = store.booked(LEAGUE), store.booked_episodes(LEAGUE)
            matches = store.matches(LEAGUE, "rating")
            failed = [job.error for job in store.jobs(LEAGUE) if job.failures]
    if failed:
        sys.exit(f"a job failed: {failed[0]}")
    first = min((at for at, share in samples if share is not None), default=0.0)
    found = windows(points, max(args.warm, first))
    shares = [share for _, share in samples if share is not None]
    return {
        "first_line": output.splitlines()[0], "modules_told": output.count("load on device"),
        "wall_seconds": round(time.monotonic() - began, 1), "matches_from_training_second": round(first, 1),
        "steps_per_second": spread(found, 0) if found else None, "windows": len(found),
        "rated_episodes": episodes, "device_seconds": round(took, 2),
        "games_per_device_second": round(episodes / took, 1) if took else None,
        "void_share_of_matches": round(sum(m.voids for m in matches) / episodes, 4) if episodes else None,
        "share": spread(shares) if shares else None, "samples": [(round(at, 1), share) for at, share in samples],
    }  # fmt: skip


def sampled(process: subprocess.Popen, where: Path) -> list[tuple[float, float | None]]:
    """Return (seconds of training, share of matches in the last 30 s), sampled until the process ends."""
    samples = []
    while process.poll() is None:
        time.sleep(0.5)
        with suppress(StorageError), Store.open(where) as store:
            statuses = [worker.status for worker in store.workers(LEAGUE, 5.0)]
            at = max((each["seconds"] for each in statuses if "seconds" in each), default=None)
            share = max((each["share"] for each in statuses if "share" in each), default=None)
            if at is not None:
                samples.append((at, share))
    return samples


def windows(points: list[CurvePoint], since: float) -> list[float]:
    """Return steps/s in windows of 30 s of training; one begins at each iteration after the second `since`."""
    found, end = [], 0
    for i, first in enumerate(points):
        end = max(end, i)
        while end < len(points) and points[end].seconds - first.seconds < WINDOW:
            end += 1
        if end == len(points):
            break
        if first.seconds >= since:
            found.append((points[end].step - first.step) / (points[end].seconds - first.seconds))
    return found


if __name__ == "__main__":
    main()
