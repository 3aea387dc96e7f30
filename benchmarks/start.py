"""Time until a league's first learning step, with an empty and a full cache, and its GPU's load afterwards.

    python -m benchmarks.start --out benchmarks/results/start-cpu.json
    python -m benchmarks.start --worlds 4096 --busy 300 --out benchmarks/results/start-h200.json
    python -m benchmarks.start --worlds 4096 --rounds 2 --against before --out benchmarks/results/start-before-h100.json

Runs `league run` with a new, empty cache of compiled kernels (cold) and again with the cache that the first run filled
(warm), `--rounds` times each; arguments after `--` are further flags of `league run`. The first learning step is the
moment when the training of the first checkpoint began, without compilation. `--against` names a folder with another
commit's tree, which takes turns with this one, each with caches of its own. With `--busy`, a third league trains for
that many seconds, with rating and recording as usual, while `nvidia-smi` reports every half second the share of time in
which a kernel was running. Prints and writes JSON.
"""

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

from scripts.record import ROOT, make_parser, report, run_info, split_arguments, spread
from storage.store import Store

LEAGUE = "start"
SAMPLE = ["nvidia-smi", "--query-gpu=index,utilization.gpu", "--format=csv,noheader,nounits", "--loop-ms=500"]


def main() -> None:
    """Measure and write the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--worlds", type=int, help="default: the league's own")
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--against", type=Path, help="the root of another commit's tree, which takes turns")
    parser.add_argument("--busy", type=int, default=0, help="seconds of training in the league whose GPU is observed")
    own, further = split_arguments(sys.argv[1:])
    args = parser.parse_args(own)
    flags = [*(["--training.worlds", str(args.worlds)] if args.worlds else []), *further]
    trees = {"": ROOT, **({"_against": args.against.resolve()} if args.against else {})}
    found: dict[str, list[float]] = {f"{t}{name}": [] for name in trees for t in ("cold", "warm")}
    busy = None
    for number in range(args.rounds):
        for name in list(trees) if number % 2 else reversed(trees):
            with tempfile.TemporaryDirectory() as cache:
                for temperature in (f"cold{name}", f"warm{name}"):
                    found[temperature].append(first_step(args.arena, cache, "2s", flags, trees[name])["first_step"])
                    print(f"{temperature}: {found[temperature][-1]:.1f} s", flush=True)
                if args.busy and not name and number == args.rounds - 1:
                    busy = gpu_load(args.arena, cache, args.busy, flags)
    result = {
        **run_info(args.commit), "arena": args.arena, "worlds": args.worlds,
        **{f"seconds_to_first_learning_step_{name}": spread(seconds, 1) for name, seconds in found.items()},
        "busy": busy,
    }  # fmt: skip
    report(result, args.out)


def first_step(arena: str, cache: str, train: str, flags: list[str], tree: Path = ROOT) -> dict[str, float]:
    """Run a league of the code in `tree` and return its times.

    Returns:
        Unix times at which it began to learn (`since`) and made its last checkpoint (`until`), and the seconds from
        the command to the first learning step (`first_step`).
    """
    with tempfile.TemporaryDirectory() as folder:
        where, began = Path(folder, "store"), time.time()
        command = [sys.executable, "-m", "league", "run", "--store", str(where), "--league", LEAGUE]
        settings = ["--arena.name", arena, "--budget.training_time", train, "--budget.rating_time", "0s"]
        path = os.pathsep.join([str(tree), *filter(None, [os.environ.get("PYTHONPATH")])])
        environment = {**os.environ, "ROBOT_LEAGUE_CACHE": cache, "PYTHONPATH": path}
        subprocess.run([*command, *settings, *flags], env=environment, cwd=tree, check=True, stdout=subprocess.DEVNULL)
        with Store.open(where) as store:
            kept = [c for c in store.checkpoints(LEAGUE) if c.iteration > 0]
    since = min(c.created - c.seconds for c in kept)
    return {"since": since, "until": max(c.created for c in kept), "first_step": since - began}


def gpu_load(arena: str, cache: str, seconds: int, flags: list[str]) -> dict[str, float]:
    """Return the mean load of the first GPU while a league learns, and for how many seconds it learns."""
    with sampled() as samples:
        times = first_step(arena, cache, f"{seconds}s", flags)
    shares = [share for at, share in samples if times["since"] <= at <= times["until"]]
    return {
        "seconds": round(times["until"] - times["since"], 1), "samples": len(shares),
        "busy": round(float(np.mean(shares)) / 100, 3),
    }  # fmt: skip


@contextmanager
def sampled() -> Iterator[list[tuple[float, float]]]:
    """Yield a list that fills with (Unix time, percent) of the first visible GPU until the context ends."""
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
