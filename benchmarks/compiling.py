"""Seconds that `learner.compiled` costs at the start, and the training after which it has saved them.

    python -m benchmarks.compiling --worlds 256 --out benchmarks/results/compiling-cpu.json
    python -m benchmarks.compiling --worlds 4096 16384 --out benchmarks/results/compiling-h100.json

For each number of worlds two processes, one after the other, learn from batches of an arena: the first with an empty
cache of torch.compile, the second with the cache that the first filled. In each, learners of all teams make updates
plainly, then compiled ones from the same state, whose first updates compile (and record CUDA graphs, as the plain ones
do). `cost` is what the first updates take beyond as many later ones, compiled minus plain. An iteration is a rollout
and the updates of all teams; `pays_after` is cost / (plain - compiled) in iterations, and in seconds of training.
Prints and writes JSON.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from typing import Any

from scripts.record import ROOT, make_parser, report, run_info, spread

FIRST = 4  # updates that compile, or record graphs


def main() -> None:
    """Measure and write the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--worlds", type=int, nargs="+", default=[256])
    parser.add_argument("--decisions", type=int, default=32, help="of a rollout")
    parser.add_argument("--repeats", type=int, default=12, help="timed updates and rollouts")
    parser.add_argument("--warm", type=float, default=2.0, help="seconds of play before the batch")
    parser.add_argument("--of", type=int, help=argparse.SUPPRESS)  # worlds, in a process that is timed
    args = parser.parse_args()
    if args.of:
        print(json.dumps(measure(args)))
        return
    found = {}
    for worlds in args.worlds:
        with tempfile.TemporaryDirectory() as cache:
            variables = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": cache}
            command = [sys.executable, "-m", "benchmarks.compiling", *sys.argv[1:], "--of", str(worlds)]
            for temperature in ("cold", "warm"):
                done = subprocess.run(command, env=variables, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
                found[f"{worlds} worlds, {temperature}"] = json.loads(done.stdout.splitlines()[-1])
                print(worlds, temperature, done.stdout.splitlines()[-1], flush=True)
    report({**run_info(args.commit), "arena": args.arena, "found": found}, args.out)


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Time plain and compiled updates of all teams in this process."""
    from league.system.environment import prepare

    prepare()  # before jax reads the environment
    import torch

    from arenas.physics.cpu import cores
    from benchmarks.loop import Ground
    from league.config import experiment as configuration
    from league.training.update_pool import UpdatePool, UpdateRequest

    torch.set_num_threads(max(1, cores() // 2))  # as in a worker of a league
    ground = Ground(replace(configuration.default(args.arena)), args.of, args)
    loop = ground.loop
    rollouts = [float(loop.play(loop.roll)[0]) for _ in range(args.repeats)]
    batches = [loop.batch(team, loop.trajectory) for team in range(len(loop.learners))]
    state = [learner.save() for learner in loop.learners]
    seconds: dict[str, list[float]] = {}
    for name, compiled in (("plain", False), ("compiled", True)):
        learners = ground.learners(compiled=compiled)
        for learner, each in zip(learners, state, strict=True):
            learner.load(each)
        pool = UpdatePool(learners)
        if not compiled:  # compiled updates have no workers
            pool.start_workers(len(learners))
        update = partial(pool, [UpdateRequest(*each) for each in zip(learners, batches, strict=True)])
        seconds[name] = []
        for _ in range(FIRST + args.repeats):
            began = time.perf_counter()
            update()
            if torch.cuda.is_available():
                torch.cuda.synchronize()
            seconds[name].append(time.perf_counter() - began)
    later = {name: spread(each[FIRST:], 4) for name, each in seconds.items()}
    first = {name: sum(each[:FIRST]) - FIRST * later[name]["median"] for name, each in seconds.items()}
    cost, saved = first["compiled"] - first["plain"], later["plain"]["median"] - later["compiled"]["median"]
    iteration = spread(rollouts, 4)["median"] + later["compiled"]["median"]
    return {
        "updates_of_all_teams": later, "rollout": spread(rollouts, 4),
        "first_updates": {name: [round(x, 2) for x in each[:FIRST]] for name, each in seconds.items()},
        "cost": round(cost, 1),
        "pays_after": {"iterations": round(cost / saved), "seconds": round(cost / saved * iteration)}
        if saved > 0
        else None,
    }  # fmt: skip


if __name__ == "__main__":
    main()
