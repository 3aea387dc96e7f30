"""How fast arenas are, and what their contacts ask of the solver. Prints each as it goes and writes JSON.

    python benchmarks/arenas.py --out benchmarks/results/arenas-cpu.json
    python benchmarks/arenas.py --engines warp c --worlds 4096 16384 --out benchmarks/results/arenas-h100.json
    python benchmarks/arenas.py --league runs/rovers --engines warp --worlds 4096 --out benchmarks/results/trained.json

For every arena, engine and number of worlds, each in a process of its own:

- environment steps/s (control steps) of the whole step: policies of both teams, observation, reward, ends, new starts,
  in one compiled rollout as training has it; and of the bare engine that replays the same controls from the same states
  right after it. The two take turns over `--repeats` stretches of play; `ratio` is whole over bare, of each pair, by
  the wall's clock and by CPU time.
- contacts, constraint rows and solver iterations of every substep of that play: mean, 99.99th percentile, most.
- `caps`: how far an iteration cap leads away from a converged solve over one control step.
- memory, voids, and how often episodes ended.
- with `--kernels`, on a GPU: which of its kernels the bare engine spent its time in, over one stretch.

Who plays: each team's script (`--scripts`, the first that it knows) and beside it an untrained network, so that both
are paid for; with `--league` the newest snapshots of a league, in its own arena.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import arenas  # noqa: E402
from agents.bridge import to_jax  # noqa: E402
from agents.networks import Actor  # noqa: E402
from agents.policy import Crew, crew  # noqa: E402
from agents.rollout import make_reset, make_rollout, scripts_of  # noqa: E402
from agents.settings import Architecture, HappoConfig  # noqa: E402
from arenas.arena import Arena  # noqa: E402
from arenas.errors import ArenaError  # noqa: E402
from benchmarks.kernels import profiled  # noqa: E402
from benchmarks.record import commit, machine, spread, tail  # noqa: E402
from benchmarks.replay import Accelerated, Pair, cap_errors, counts  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.policies import seat, thaw  # noqa: E402
from league.standing import Standing  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.store import Store  # noqa: E402

CAPS = [
    (4, 10),
    (6, 10),
    (8, 10),
    (10, 20),
    (10, 4),
    (12, 4),
    (14, 4),
    (16, 4),
    (16, 10),
    (20, 4),
]  # line-search steps last


def main() -> None:
    """Measure and write the JSON after each."""
    args = arguments()
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": args.commit or commit(), "machine": machine(),
        "versions": versions(), "arenas": [],
    }  # fmt: skip
    every = [(name, engine, worlds) for name in names(args) for engine in args.engines for worlds in args.worlds]
    for name, engine, worlds in every:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
            found = alone.submit(measure, args, name, engine, worlds).result()
        print(json.dumps(found, indent=1), flush=True)
        result["arenas"].append(found)
        if args.out:
            args.out.write_text(json.dumps(result, indent=1) + "\n")


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arenas", nargs="+", help="those to measure (default: all that come with the league)")
    parser.add_argument("--engines", nargs="+", default=["auto"], help="auto, c, jax, warp")
    parser.add_argument("--worlds", type=int, nargs="+", default=[256])
    parser.add_argument("--decisions", type=int, default=32, help="of a stretch of play")
    parser.add_argument("--repeats", type=int, default=8, help="stretches of play that are timed")
    parser.add_argument("--warm", type=float, default=8.0, help="seconds of play before the first of them")
    parser.add_argument("--scripts", nargs="+", default=["pusher", "trot", "random"], help="who plays, by preference")
    parser.add_argument("--hidden", type=int, nargs="+", default=[128, 128], help="of the networks beside scripts")
    parser.add_argument("--league", type=Path, help="a league's store: its newest snapshots play, in its arena")
    parser.add_argument("--league-name", help="which league of the store, if it has several")
    parser.add_argument("--no-caps", action="store_true", help="leave the solver's caps out")
    parser.add_argument("--kernels", type=int, default=0, help="tell so many of a GPU's kernels, the longest")
    parser.add_argument("--commit", default="", help="the commit, where there is no git to ask")
    parser.add_argument("--out", type=Path)
    return parser.parse_args()


def names(args: argparse.Namespace) -> list[str]:
    """The arenas to measure; those without bodies have no engine to compare with."""
    if args.league:
        with Store.open(args.league) as store:
            return [configuration.loads(store.league(league(args, store)).config).arena.name]
    return args.arenas or [name for name in arenas.names() if arenas.load(name, engine="c").scene.agents]


def league(args: argparse.Namespace, store: Store) -> str:
    """The league of the store that is meant."""
    found = [one.name for one in store.leagues()]
    if args.league_name is None and len(found) != 1:
        raise SystemExit(f"--league-name: {args.league} has {', '.join(found) or 'no leagues'}")
    return args.league_name or found[0]


def measure(args: argparse.Namespace, name: str, engine: str, worlds: int) -> dict:
    """All about one arena on one engine with so many worlds."""
    arena, crews, who = cast(args, name, engine, worlds)
    rollout = make_rollout(arena, args.decisions)
    began = time.perf_counter()
    now = make_reset(arena)(jax.random.split(jax.random.key(0), worlds))
    now, _ = jax.block_until_ready(rollout(crews, now, jax.random.key(1)))
    compiling = time.perf_counter() - began
    decision = arena.timing.control_interval * arena.timing.hold
    for i in range(round(args.warm / decision / args.decisions)):
        now, _ = rollout(crews, now, jax.random.key(1000 + i))
    pair, steps = Pair(arena, worlds, args.decisions), worlds * args.decisions * arena.timing.hold
    took: dict[str, list[np.ndarray]] = {"whole": [], "bare": []}  # (wall, CPU) s
    seen: list[dict[str, np.ndarray]] = []
    ends = {"terminated": 0, "truncated": 0, "void": 0}
    play = None
    for i in range(args.repeats + 1):  # the first one compiles
        now, trajectory, play, whole, replayed = pair.stretch(partial(rollout, crews), now, jax.random.key(2000 + i))
        if i == 0:
            continue
        took["whole"].append(whole)
        took["bare"].append(replayed)
        told = pair.alone.told(play) if isinstance(pair.alone, Accelerated) else {}
        seen.append(counts(arena.scene.model, play) | told)
        for end in ends:
            cuts = trajectory.cut if end == "truncated" else False
            ends[end] += int((getattr(trajectory, end) & ~jnp.asarray(cuts)).sum())
    assert play is not None
    ratios = np.divide(took["bare"], took["whole"])  # (repeats, 2)
    found = {
        "arena": name, "engine": arena.engine.name, "worlds": worlds, "nv": arena.scene.model.nv, "players": who,
        "control_steps_per_decision": arena.timing.hold, "substeps_per_control_step": arena.timing.substeps,
        "compile_seconds": round(compiling, 1),
        "steps_per_second": {part: spread(steps / np.array(of)[:, 0], 0) for part, of in took.items()},
        "ratio": spread(ratios[:, 0]), "ratio_of_cpu_time": spread(ratios[:, 1]),
        "substeps": {field: tail(np.stack([stretch[field] for stretch in seen])) for field in seen[0]},
        "solver": {k: getattr(arena.scene.model.opt, k) for k in ("iterations", "ls_iterations")},
        "decisions": args.repeats * args.decisions * worlds, "ends": ends, "memory": memory(),
    }  # fmt: skip
    if args.kernels and jax.default_backend() != "cpu":
        kernels = profiled(partial(pair.alone.seconds, play))
        found["kernels"] = kernels | {"by_name": dict(list(kernels["by_name"].items())[: args.kernels])}
    if not args.no_caps:
        errors = cap_errors(arena, play, CAPS)
        found["caps"] = [
            {"iterations": cap[0], "ls_iterations": cap[1], **{k: tail(gaps) for k, gaps in of.items()}}
            for cap, of in errors.items()
        ]
    return found


def cast(args: argparse.Namespace, name: str, engine: Any, worlds: int) -> tuple[Arena, dict[str, Crew], list[str]]:
    """The arena, its crews of one group each, and who they are, team by team."""
    if args.league:
        return trained(args, engine, worlds)
    arena = arenas.load(name, engine=engine, worlds=worlds)
    crews, who = {}, []
    config = HappoConfig(architecture=Architecture(hidden=tuple(args.hidden)))
    for team in arena.teams:
        known = [script for script in args.scripts if script in arena.playable(team)]
        if not known:
            raise ArenaError(f"{name}: team {team.name} knows {', '.join(arena.playable(team))}, none of --scripts")
        who.append(known[0])
        for agent in team.agents:
            actor = Actor(agent.observation_size, agent.action_size, config.architecture, config.initial_std)
            number = list(scripts_of(arena, agent.kind)).index(known[0])
            crews[agent.name] = crew([number], also=to_jax([actor.state_dict()]))
    return arena, crews, who


def trained(args: argparse.Namespace, engine: Any, worlds: int) -> tuple[Arena, dict[str, Crew], list[str]]:
    """The same with a league's newest snapshots."""
    with Store.open(args.league) as store:
        title = league(args, store)
        arena = configuration.loads(store.league(title).config).arena.build(engine=engine, worlds=worlds)
        standing = Standing.of(store, title)
        first = {player.team: player for player in reversed(standing.players)}
        newest = [standing.history(first[team].name)[-1] for team in range(len(arena.teams))]
        return arena, seat(arena.teams, [[thaw(store, s, arena)] for s in newest]), [s.name for s in newest]


def memory() -> dict:
    """MB that this process has held at most: on the host and, by jax's count, on the device."""
    found = {"host_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)}
    told = jax.local_devices()[0].memory_stats() or {}
    return found | ({"device_mb": round(told["peak_bytes_in_use"] / 2**20)} if "peak_bytes_in_use" in told else {})


if __name__ == "__main__":
    main()
