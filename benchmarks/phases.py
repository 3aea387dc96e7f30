"""Time of each part of a training process's start, up to the first learning step.

    python -m benchmarks.phases --worlds 4096 --out benchmarks/results/phases-h200.json

Prepares a league as `league run` does. Then a process does the first turns of a train worker: once with a new, empty
cache of compiled kernels (cold), and once with the cache that the first left (warm). `trace`, `lower` and `compile` are
JAX's own sums over all its programs; `compile` is XLA's compilation or the reading of its cache. The first iteration
also loads, records or tunes what is used for the first time; the difference from the second shows that cost. Prints
and writes JSON.
"""

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

from league.system import environment

LEAGUE = "phases"
JAX_EVENTS = {
    "jaxpr_trace_duration": "trace", "jaxpr_to_mlir_module_duration": "lower", "backend_compile_duration": "compile"
}  # fmt: skip


class Marks:
    """Seconds of consecutive parts, by name."""

    def __init__(self, began: float):
        self.seconds: dict[str, float] = {}
        self._last = began

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time a part, from the end of the one before to the end of the context."""
        yield
        now = time.time()
        self.seconds[name], self._last = now - self._last, now


def count_compile_seconds() -> defaultdict[str, float]:
    """Return a counter that JAX fills with the seconds of its phases of compiling."""
    import jax

    events: defaultdict[str, float] = defaultdict(float)

    def listen(event: str, duration_secs: float, **_: str | int) -> None:
        events[JAX_EVENTS.get(event.rpartition("/")[2], "")] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    return events


def start_parts(where: str, began: float) -> dict[str, object]:
    """Go through the start of a train worker in this process and return the seconds of each part.

    Args:
        where: the store.
        began: Unix time at which this process was started.
    """
    part = Marks(began)
    with part("python"):
        environment.prepare()
    with part("import torch"):
        import torch
    with part("import the trainer, with jax"):
        import jax

        from league.config import experiment as configuration
        from league.scheduling.turn_scheduler import next_turns
        from league.state.jobs import TrainingTurn, decode
        from league.state.league_state import LeagueState
        from league.system.arena_build import worlds as training_worlds
        from league.training.trainer import Trainer
        from storage.store import Store
    events = count_compile_seconds()
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
            """Do the next turn as a worker does; return the seconds of training of its first iteration."""
            planned = next_turns(config, LeagueState.of(store, LEAGUE))
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
        "of these": {name: round(events[name], 2) for name in JAX_EVENTS.values()},
    }  # fmt: skip


def main() -> None:
    """Measure and write the JSON."""
    if sys.argv[1:2] == ["--of"]:  # the process that is timed, which imports nothing before
        print(json.dumps(start_parts(sys.argv[2], float(sys.argv[3]))))
        return
    environment.prepare()
    from scripts.record import make_parser, report, run_info

    parser = make_parser(__doc__)
    parser.add_argument("--arena", default="sumo-2v2")
    parser.add_argument("--worlds", type=int, help="default: the league's own")
    args = parser.parse_args()
    from league.config import experiment as configuration
    from league.config.run_spec import RunSpec
    from league.runtime.preflight import prepare

    config = replace(configuration.default(args.arena), league=LEAGUE)
    config = replace(config, training=replace(config.training, worlds=args.worlds))
    found: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as folder:
        for temperature in ("cold", "warm"):
            where, began = str(Path(folder, temperature)), time.time()
            prepare(RunSpec.of(where, config), config)
            took = round(time.time() - began, 2)
            parts = timed(where, {**os.environ, "ROBOT_LEAGUE_CACHE": str(Path(folder, "cache"))})
            found[temperature] = {"before it, a process that prepares the league": took, **parts}
    report({**run_info(args.commit), "arena": args.arena, "worlds": args.worlds, **found}, args.out)


def timed(where: str, variables: dict[str, str]) -> dict[str, object]:
    """Return the seconds of each part in a new process with these environment variables."""
    for name in ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH"):  # set by this process for its children
        variables.pop(name, None)
    command = [sys.executable, "-m", "benchmarks.phases", "--of", where, str(time.time())]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=variables)
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
