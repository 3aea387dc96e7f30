"""What a process that trains does before it learns, and how long each part takes. Prints and writes JSON.

    python benchmarks/phases.py --worlds 4096 --out benchmarks/results/phases-h200.json

A league is made as `league run` makes it; then a process does its first turns as a train worker does, once with a cache
of compiled kernels that is new and empty and once with what that left. The parts follow each other up to the first
learning step. `trace`, `lower` and `compile` are what JAX tells of all its programs, `compile` being what XLA takes or
the reading of its cache. The first iteration has what is loaded, recorded or tuned when it is first used: how much
longer it is than the second says what that costs.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # this folder has an arenas.py too

from league import environment  # noqa: E402

LEAGUE = "phases"
TOLD = {
    "jaxpr_trace_duration": "trace", "jaxpr_to_mlir_module_duration": "lower", "backend_compile_duration": "compile"
}  # fmt: skip


class Marks:
    """Seconds from one mark to the next."""

    def __init__(self, began: float):
        self.seconds: dict[str, float] = {}
        self._last = began

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """What happens now, up to the end of the context."""
        yield
        now = time.time()
        self.seconds[name], self._last = now - self._last, now


def gone_through(where: str, began: float) -> dict[str, object]:
    """The parts, in this process; `began` is when it was started, on the clock."""
    part = Marks(began)
    with part("python"):
        environment.prepare()
    with part("import torch"):
        import torch
    with part("import the trainer, with jax"):
        import jax

        from league.config import experiment as configuration
        from league.examine import worlds as training_worlds
        from league.jobs import TrainingTurn, decode
        from league.plan import next_turns
        from league.standing import Standing
        from league.train import Trainer
        from storage.store import Store
    told: defaultdict[str, float] = defaultdict(float)

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        told[TOLD.get(event.rpartition("/")[2], "")] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    with part("find the devices"):
        jax.devices()
        if torch.cuda.is_available():
            torch.cuda.init()
    with Store.open(where) as store:
        config = configuration.loads(store.league(LEAGUE).config)
        with part("build the arena"):
            worlds = training_worlds(config)
            arena = config.arena.build(engine=config.engine, worlds=worlds, threads=config.workers.threads)
        with part("make learners"):
            trainer = Trainer(config, arena, store.players(LEAGUE), worlds)

        def turn() -> float:
            """Do the next one as a worker does; the seconds of training that its first iteration took."""
            planned = next_turns(config, Standing.of(store, LEAGUE))
            store.queue(planned.jobs, planned.phases)
            claimed = store.claim(LEAGUE, [TrainingTurn.kind], "phases", 3600)
            assert claimed
            task = decode(claimed[1])
            assert isinstance(task, TrainingTurn)
            done = list(trainer.turn(store, task, lambda: True))
            trainer.commit(store, claimed[0], task)
            return max((c.seconds for at in done for c in at.counters.values()), default=0.0)

        with part("the first snapshots"):
            turn()
        with part("the rollout"):
            first = turn()
        second = turn() - first
    part.seconds["the rollout"] -= first
    return {
        "seconds": round(sum(part.seconds.values()), 1), "parts": {k: round(v, 2) for k, v in part.seconds.items()},
        "the first iteration": round(first, 2), "the second iteration": round(second, 2),
        "of these": {name: round(told[name], 2) for name in TOLD.values()},
    }  # fmt: skip


def main() -> None:
    """Measure and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--worlds", type=int, help="default: the league's own")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--of", help=argparse.SUPPRESS)  # the store, in the process that is watched
    parser.add_argument("--began", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.of:
        print(json.dumps(gone_through(args.of, args.began)))
        return
    environment.prepare()
    from benchmarks.record import commit, machine, tell
    from league.config import experiment as configuration
    from league.prepare import prepare
    from league.versions import versions

    config = replace(configuration.default(args.arena), league=LEAGUE)
    config = replace(config, training=replace(config.training, worlds=args.worlds))
    found: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        for temperature in ("cold", "warm"):
            where, began = str(Path(folder, temperature)), time.time()
            prepare(where, config)
            took = round(time.time() - began, 2)
            told = watched(where, {**os.environ, "ROBOT_LEAGUE_CACHE": str(Path(folder, "cache"))})
            found[temperature] = {"before it, a process that prepares the league": took, **told}
    about = {"benchmark": "phases", "commit": args.commit or commit(), "machine": machine(), "versions": versions()}
    tell({**about, "arena": args.arena, "worlds": args.worlds, **found}, args.out)


def watched(where: str, variables: dict[str, str]) -> dict[str, object]:
    """The parts, in a process of its own."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH"):  # set by this process for its children
        variables.pop(name, None)
    command = [sys.executable, __file__, "--of", where, "--began", str(time.time())]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=variables)
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
