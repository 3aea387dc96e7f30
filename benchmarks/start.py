"""How soon a league learns, with nothing compiled and with all, and how busy its GPU then is. Prints and writes JSON.

    python benchmarks/start.py --out benchmarks/results/start-cpu.json
    python benchmarks/start.py --worlds 4096 --busy 300 --out benchmarks/results/start-h200.json

Runs `league run` with a cache of compiled kernels that is new and empty, and once more with what the first has left in
it, `--rounds` times each. The first learning step is when the training of the first checkpoint began, compiling apart;
what follows `--` are further flags of that command. With `--busy` a third league, rated and recorded as any, trains for
so many seconds beside `nvidia-smi`, which tells every half second in which share of the time a kernel was running.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from benchmarks.record import commit, machine, own_and_further, spread  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.store import Store  # noqa: E402

LEAGUE = "start"
SAMPLE = ["nvidia-smi", "--query-gpu=index,utilization.gpu", "--format=csv,noheader,nounits", "--loop-ms=500"]


def main() -> None:
    """Measure and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--worlds", type=int, help="default: the league's own")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--busy", type=int, default=0, help="seconds of training in the league that is watched")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("--out", type=Path)
    own, further = own_and_further(sys.argv[1:])
    args = parser.parse_args(own)
    flags = [*(["--training.worlds", str(args.worlds)] if args.worlds else []), *further]
    found: dict[str, list[float]] = {"cold": [], "warm": []}
    busy = None
    for last in (i == args.rounds - 1 for i in range(args.rounds)):
        with tempfile.TemporaryDirectory() as cache:
            for temperature, seconds in found.items():
                seconds.append(first_step(args.arena, cache, "2s", flags)["first_step"])
                print(f"{temperature}: {seconds[-1]:.1f} s", flush=True)
            if last and args.busy:
                busy = watched(args.arena, cache, args.busy, flags)
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "machine": machine(),
        "versions": versions(), "arena": args.arena, "worlds": args.worlds,
        **{f"seconds_to_first_learning_step_{name}": spread(seconds, 1) for name, seconds in found.items()},
        "busy": busy,
    }  # fmt: skip
    print(json.dumps(result, indent=1), flush=True)
    if args.out:
        args.out.write_text(json.dumps(result, indent=1) + "\n")


def first_step(arena: str, cache: str, train: str, flags: list[str]) -> dict[str, float]:
    """Run a league; when it began to learn and when it ended, on the clock and in seconds after the command."""
    with tempfile.TemporaryDirectory() as folder:
        where, began = Path(folder, "store"), time.time()
        command = [sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE]
        told = ["--arena.name", arena, "--budget.train", train, "--budget.rate", "0s"]
        environment = {**os.environ, "ROBOT_LEAGUE_CACHE": cache}
        subprocess.run(
            [*command, *told, *flags], cwd=sys.path[0], env=environment, check=True, stdout=subprocess.DEVNULL
        )
        with Store.open(where) as store:
            kept = [c for c in store.checkpoints(LEAGUE) if c.iteration > 0]
    since = min(c.created - c.seconds for c in kept)
    return {"since": since, "until": max(c.created for c in kept), "first_step": since - began}


def watched(arena: str, cache: str, seconds: int, flags: list[str]) -> dict[str, float]:
    """How busy the first GPU was while a league learnt, and how long that took."""
    with sampled() as samples:
        told = first_step(arena, cache, f"{seconds}s", flags)
    shares = [share for at, share in samples if told["since"] <= at <= told["until"]]
    return {
        "seconds": round(told["until"] - told["since"], 1), "samples": len(shares),
        "busy": round(float(np.mean(shares)) / 100, 3),
    }  # fmt: skip


@contextmanager
def sampled() -> Iterator[list[tuple[float, float]]]:
    """A list that fills with (time, percent) of the first GPU that is visible, until the context ends."""
    samples: list[tuple[float, float]] = []
    first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0]
    with subprocess.Popen([*SAMPLE, f"--id={first}"], stdout=subprocess.PIPE, text=True) as smi:
        thread = threading.Thread(target=_read, args=(smi.stdout, samples), daemon=True)
        thread.start()
        try:
            yield samples
        finally:
            smi.terminate()
            thread.join()


def _read(lines: Iterable[str], samples: list[tuple[float, float]]) -> None:
    for line in lines:
        samples.append((time.time(), float(line.split(",")[1])))


if __name__ == "__main__":
    main()
