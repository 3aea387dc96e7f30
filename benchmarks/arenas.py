"""Speed of arenas, and the work that their contacts cause in the solver. Prints each result and writes JSON.

    python -m benchmarks.arenas --out benchmarks/results/arenas-cpu.json
    python -m benchmarks.arenas --engines warp c --worlds 4096 16384 --out benchmarks/results/arenas-h100.json
    python -m benchmarks.arenas --league runs/rovers --engines warp --worlds 4096 --out trained.json

Each combination of arena, engine and number of worlds runs in a process of its own and gives:

- `steps_per_second`: control steps/s of a whole rollout as in training (policies of all teams, observation, reward,
  ends and new starts, compiled as one program), and of the bare engine, which replays the same controls from the same
  states directly afterwards. Both alternate over `--repeats` stretches of play; `ratio` is bare / whole in seconds of
  each pair, by wall-clock time and by CPU time.
- `substeps`: contacts, constraint rows and solver iterations of every substep: mean, 99.99th percentile, maximum.
- `caps`: the error that a cap on solver iterations causes over one control step, compared with a converged solve.
- `memory`, and `ends`: how many episodes terminated, were truncated or void.
- `kernels`, with `--kernels` on a GPU: the GPU kernels in which the bare engine spends its time.

Each robot is controlled by a script (`--scripts`, the first that its team knows), and an untrained network is evaluated
beside it, so that the time of both is measured. With `--league`, the newest snapshots of a league play in its arena.
"""

import argparse
import json
import multiprocessing
import resource
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import jax.numpy as jnp
import numpy as np

import arenas
from agents.bridge import to_jax
from agents.policy.jax_policy import PolicyStack, stack_policies
from agents.policy.networks import Actor
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_rollout, scripts_for
from agents.settings import Architecture, HappoConfig
from arenas.arena import Arena
from arenas.errors import ArenaError
from benchmarks.kernels import profiled
from benchmarks.replay import Accelerated, Pair, cap_errors, counts
from league.config import experiment as configuration
from league.snapshots.codec import seat, thaw
from league.state.league_state import LeagueState
from scripts.record import make_parser, run_info, spread, tail, write
from storage.store import Store

# (solver iterations, line-search steps)
CAPS = [(4, 10), (6, 10), (8, 10), (10, 20), (10, 4), (12, 4), (14, 4), (16, 4), (16, 10), (20, 4)]


def main() -> None:
    """Measure each combination and write the JSON after it."""
    args = arguments()
    result = {**run_info(args.commit), "arenas": []}
    every = [(name, engine, worlds) for name in names(args) for engine in args.engines for worlds in args.worlds]
    for name, engine, worlds in every:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as alone:
            found = alone.submit(measure, args, name, engine, worlds).result()
        print(json.dumps(found, indent=1), flush=True)
        result["arenas"].append(found)
        write(result, args.out)


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--arenas", nargs="+", help="default: all that come with the league")
    parser.add_argument("--engines", nargs="+", default=["auto"], help="auto, c, jax, warp")
    parser.add_argument("--worlds", type=int, nargs="+", default=[256])
    parser.add_argument("--decisions", type=int, default=32, help="in a stretch of play")
    parser.add_argument("--repeats", type=int, default=8, help="timed stretches of play")
    parser.add_argument("--warm", type=float, default=8.0, help="seconds of play before the first timed stretch")
    parser.add_argument("--scripts", nargs="+", default=["pusher", "trot", "random"], help="preferred first")
    parser.add_argument("--hidden", type=int, nargs="+", default=[128, 128], help="of the untrained networks")
    parser.add_argument("--league", type=Path, help="store of a league whose newest snapshots play in its arena")
    parser.add_argument("--league-name", help="the league of the store, if it has several")
    parser.add_argument("--no-caps", action="store_true", help="skip the caps on solver iterations")
    parser.add_argument("--kernels", type=int, default=0, help="list this many GPU kernels, the longest first")
    return parser.parse_args()


def names(args: argparse.Namespace) -> list[str]:
    """Arenas to measure; arenas without bodies have no engine to compare with."""
    if args.league:
        with Store.open(args.league) as store:
            return [configuration.loads(store.league(league(args, store)).config).arena.name]
    return args.arenas or [name for name in arenas.names() if arenas.load(name, engine="c").scene.agents]


def league(args: argparse.Namespace, store: Store) -> str:
    """Return the name of the store's league. Raises SystemExit if it is ambiguous."""
    found = [one.name for one in store.leagues()]
    if args.league_name is None and len(found) != 1:
        raise SystemExit(f"--league-name: {args.league} has {', '.join(found) or 'no leagues'}")
    return args.league_name or found[0]


def measure(args: argparse.Namespace, name: str, engine: str, worlds: int) -> dict:
    """Measure one arena on one engine with one number of worlds."""
    arena, stacks, who = load(args, name, engine, worlds)
    rollout = make_rollout(arena, args.decisions)
    began = time.perf_counter()
    now = make_reset(arena)(jax.random.split(jax.random.key(0), worlds))
    now, _ = jax.block_until_ready(rollout(stacks, now, jax.random.key(1)))
    compiling = time.perf_counter() - began
    decision = arena.timing.control_interval * arena.timing.hold
    for i in range(round(args.warm / decision / args.decisions)):
        now, _ = rollout(stacks, now, jax.random.key(1000 + i))
    pair, steps = Pair(arena, worlds, args.decisions), worlds * args.decisions * arena.timing.hold
    took: dict[str, list[np.ndarray]] = {"whole": [], "bare": []}  # (wall, CPU) s
    seen: list[dict[str, np.ndarray]] = []
    ends = {"terminated": 0, "truncated": 0, "void": 0}
    play = None
    for i in range(args.repeats + 1):  # the first stretch compiles
        now, trajectory, play, whole, replayed = pair.stretch(partial(rollout, stacks), now, jax.random.key(2000 + i))
        if i == 0:
            continue
        took["whole"].append(whole)
        took["bare"].append(replayed)
        own_counts = pair.alone.counts(play) if isinstance(pair.alone, Accelerated) else {}
        seen.append(counts(arena.scene.model, play) | own_counts)
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


def load(
    args: argparse.Namespace, name: str, engine: Any, worlds: int
) -> tuple[Arena, dict[str, PolicyStack], list[str]]:
    """Return the arena, each agent's policies for one group of worlds, and the name of each team's player."""
    if args.league:
        return trained(args, engine, worlds)
    arena = arenas.load(name, engine=engine, worlds=worlds)
    stacks, who = {}, []
    config = HappoConfig(architecture=Architecture(hidden=tuple(args.hidden)))
    for team in arena.teams:
        known = [script for script in args.scripts if script in arena.playable_scripts(team)]
        if not known:
            raise ArenaError(
                f"{name}: team {team.name} knows {', '.join(arena.playable_scripts(team))}, none of --scripts"
            )
        who.append(known[0])
        for agent in team.agents:
            actor = Actor(agent.observation_size, agent.action_size, config.architecture, config.initial_std)
            number = list(scripts_for(arena, agent.kind)).index(known[0])
            stacks[agent.name] = stack_policies([number], reserve=to_jax([actor.state_dict()]))
    return arena, stacks, who


def trained(args: argparse.Namespace, engine: Any, worlds: int) -> tuple[Arena, dict[str, PolicyStack], list[str]]:
    """Return the same as `load`, with the newest snapshots of a league."""
    with Store.open(args.league) as store:
        title = league(args, store)
        arena = configuration.loads(store.league(title).config).arena.build(engine=engine, worlds=worlds)
        state = LeagueState.of(store, title)
        first = {player.team: player for player in reversed(state.players)}
        newest = [state.history(first[team].name)[-1] for team in range(len(arena.teams))]
        return arena, seat(arena.teams, [[thaw(store, s, arena)] for s in newest]), [s.name for s in newest]


def memory() -> dict:
    """Peak memory of this process in MB: on the host and, as counted by JAX, on the device."""
    found = {"host_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)}
    stats = jax.local_devices()[0].memory_stats() or {}
    return found | ({"device_mb": round(stats["peak_bytes_in_use"] / 2**20)} if "peak_bytes_in_use" in stats else {})


if __name__ == "__main__":
    main()
