"""Use of Warp's buffers in each arena: the need, what is left, void worlds, and the cost of the buffers.

    python -m benchmarks.buffers --quick --arenas sumo-within-team --worlds 16 --policies 1 --out quick.json
    python -m benchmarks.buffers --worlds 128 4096 --cost --seconds 540 --out benchmarks/results/buffers-h100.json

Every world plays one whole episode and continues after its end, as in a rating match; fallen robots stay where they
lie. Worlds are split evenly over players and starts:

- players: untrained networks of the default learner (`--policies` of them), uniformly random actions, the arena's
  scripts, and the policies that come with the league, if they fit a team of the arena;
- starts: `usual`, as the arena places its robots; `fallen`, each on its side or back; `crowded`, the robots moved
  together; `heap`, both.

The result has, for each arena and number of worlds: for every player and start the mean over worlds of pairs, contacts
and rows at the decision where it is largest, the standard deviation, and the maximum of any world; `pool`, what all
worlds together needed in any substep, and the size of the buffer; `void`, shares of void worlds by cause, with usual
starts apart; and `slots`, the slots per world that the worst player and start would need, for several numbers of
worlds. `cost` compares rollouts with the present buffers and with those of commit 57ed746, alternating. Prints JSON.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import arenas
from agents.bridge import to_jax
from agents.policy.jax_policy import PolicyStack, decide, policy_params, stack_policies
from agents.policy.networks import Actor
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_rollout, scripts_for
from agents.settings import HappoConfig
from arenas.arena import Arena
from arenas.arena_settings import Solver
from arenas.contract.buffer_meter import with_meters
from arenas.physics.mjx import MjxEngine
from arenas.physics.void_causes import Cause
from arenas.state import State
from benchmarks.broadphase import counter
from league.snapshots.policy_file import TRAINED
from league.system import devices
from scripts.record import make_parser, run_info, write
from storage.blobs import arrays

STARTS = ("usual", "fallen", "crowded", "heap")
SIZES = (1, 16, 128, 4096, 16384)  # numbers of worlds for which the need is computed
BETWEEN = 0.8  # m, distance of the two nearest robots of a crowded start
# Contacts and rows per world in the buffers of commit 57ed746, before this benchmark; the pool was contacts × worlds.
BEFORE = {
    "anymal-walk": (16, 80), "block-push-anymal": (36, 144), "block-push-leatherback": (32, 128),
    "galaga-1v1": (16, 64), "galaga-2v2": (32, 128), "galaga-aim-1v1": (8, 32), "galaga-aim-2v2": (8, 32),
    "galaga-fly-1v1": (8, 32), "galaga-fly-2v2": (8, 32), "pursuit": (16, 16), "soccer-1v1": (20, 72),
    "soccer-2v2": (34, 114), "soccer-2v2-leatherback": (34, 114), "soccer-ball": (13, 51), "soccer-score": (13, 51),
    "soccer-score-leatherback": (13, 51), "soccer-walk": (13, 51), "sumo-1v1": (18, 72), "sumo-1v1-anymal": (18, 72),
    "sumo-1v1-leatherback": (18, 72), "sumo-2v2": (32, 128), "sumo-2v2-anymal": (32, 128),
    "sumo-2v2-leatherback": (32, 128), "sumo-by-team": (32, 128), "sumo-within-team": (32, 128),
}  # fmt: skip


def main() -> None:
    """Measure each arena and write the JSON after it."""
    args, began = arguments(), time.monotonic()
    result: dict[str, Any] = {**run_info(args.commit), "arenas": {}, "left_out": []}
    for name in args.arenas or [name for name in arenas.names() if arenas.load(name, engine="c").engine.name != "none"]:
        if time.monotonic() - began > args.seconds:
            result["left_out"].append(name)
            continue
        found = result["arenas"][name] = measured(args, name)
        print(name, json.dumps(found if args.quick else summary(found)), flush=True)
        write(result, args.out)
        jax.clear_caches()


def arguments() -> argparse.Namespace:
    """Parse the command line."""
    parser = make_parser(__doc__)
    parser.add_argument("--arenas", nargs="+", help="default: all that come with the league")
    parser.add_argument("--worlds", type=int, nargs="+", default=[128, 4096], help="a run for each number")
    parser.add_argument("--policies", type=int, default=4, help="untrained networks")
    parser.add_argument("--decisions", type=int, help="of an episode at most (default: all)")
    parser.add_argument(
        "--buffers", type=int, nargs=3, metavar=("CONTACTS", "SPARE", "ROWS"), help="instead of its own"
    )
    parser.add_argument("--quick", action="store_true", help="only untrained and random play from usual starts")
    parser.add_argument("--cost", action="store_true", help="compare rollouts with the buffers of 57ed746")
    parser.add_argument("--seconds", type=float, default=1e9, help="begin no arena after this time")
    return parser.parse_args()


def measured(args: argparse.Namespace, name: str) -> dict:
    """Measure one arena."""
    began = time.monotonic()
    bare = arenas.load(name, engine="warp", worlds=max(args.worlds))
    buffers = Solver(contacts=args.buffers[0], spare=args.buffers[1], rows=args.buffers[2]) if args.buffers else None
    own = buffers or bare.engine.buffers  # type: ignore[attr-defined]
    found: dict[str, Any] = {"contacts": own.contacts, "spare": own.spare, "rows": own.rows, "worlds": {}}
    for worlds in args.worlds:
        found["worlds"][worlds] = played(args, with_meters(bare, worlds, buffers), worlds)
    if args.cost:
        found["cost"] = cost(name, max(args.worlds), own)
    full = [round(gpu.used, 1) for gpu in devices.memory()]  # from the driver: JAX does not know Warp's share
    return found | {"seconds": round(time.monotonic() - began, 1), "gpu_gb": full}


def played(args: argparse.Namespace, arena: Arena, worlds: int) -> dict:
    """Return needs and void shares for one number of worlds, by player and start."""
    players = players_of(arena, args.policies, args.quick)
    starts = STARTS[:1] if args.quick else STARTS
    groups, rest = len(players), worlds // len(players)
    each = rest - rest % len(starts)
    used = groups * each
    if not each:
        raise SystemExit(f"--worlds: {worlds} are too few for {groups} players and {len(starts)} starts")
    arena.engine.prepare()()  # where Warp loads a kernel while it records a program, it may lose its stream
    stacks = {a.name: stack_policies([p[a.name] for p in players.values()]) for a in arena.agents}
    kinds = jnp.tile(jnp.arange(len(starts)), used // len(starts))
    begin = jax.jit(lambda keys: jax.vmap(arena.reset)(keys))
    state = begin(jax.random.split(jax.random.key(0), used))
    state = jax.jit(jax.vmap(lambda s, k: put(arena, s, k)))(state, kinds)
    episode = make_episode(arena, min(args.decisions or arena.timing.decisions, arena.timing.decisions))
    after, series = episode(stacks, state, jax.random.key(1))
    pool_wanted = series.pop("pool")
    needs = {k: np.asarray(v).reshape(-1, groups, each // len(starts), len(starts)) for k, v in series.items()}
    void = np.asarray(after.void).reshape(groups, -1, len(starts))
    causes = np.asarray(after.causes).reshape(groups, -1, len(starts))
    table = {
        f"{player}/{start}": {
            "void": float(void[g, :, s].mean()),
            **{what: worst(values[:, g, :, s]) for what, values in needs.items()},
        }
        for g, player in enumerate(players)
        for s, start in enumerate(starts)
    }
    peaks, own = after.physics.carry.peaks, arena.engine.buffers  # type: ignore[attr-defined]
    pool = own.slots(worlds)
    return {
        "worlds": used, "pool": {"slots": pool, "pairs": int(peaks.pairs.max()), "contacts": int(peaks.contacts.max())},
        "rows": {"each": own.rows, "most": int(peaks.rows.max())},
        "void": {
            "usual": float(void[:, :, 0].mean()), "all": float(void.mean()),
            **{c.key: float((causes & c != 0).mean()) for c in Cause},
        },
        "slots": {n: round(max(needed(row["pairs"], n) for row in table.values()), 1) for n in SIZES},
        "broadphase_differs": int(np.abs(needs["pairs"].sum((1, 2, 3)) - pool_wanted).max()),
        "players": table,
    }  # fmt: skip


def worst(values: np.ndarray) -> dict:
    """Return mean and deviation over worlds of (T, n) values, in the decision of largest mean, and their maximum."""
    at = values.mean(1).argmax()
    return {
        "mean": round(float(values[at].mean()), 2), "std": round(float(values.std(1).max()), 2),
        "most": int(values.max()), "q999": float(np.quantile(values, 0.999)),
    }  # fmt: skip


def needed(pairs: dict, worlds: int) -> float:
    """Return slots per world that suffice for this number of worlds with a margin of five standard deviations."""
    return min(pairs["mean"] + 5 * pairs["std"] / worlds**0.5, max(pairs["most"], pairs["mean"]))


def make_episode(arena: Arena, decisions: int) -> Callable:
    """Return compiled `episode(stacks, state (N, ...), key) -> (state, needs)`; needs are (decisions, N) by name."""
    pairs = jax.vmap(counter(arena.engine._stepped))  # type: ignore[attr-defined]
    scripts = {agent.kind: tuple(scripts_for(arena, agent.kind).values()) for agent in arena.agents}

    def decision(stacks: dict[str, PolicyStack], state: State, key: Array) -> tuple[State, dict[str, Array]]:
        number = state.void.shape[0]
        actions = {
            a.name: decide(stacks[a.name], state.observations[a.name],
                           jax.random.split(jax.random.fold_in(key, i), number), scripts[a.kind], None).actions
            for i, a in enumerate(arena.agents)
        }  # fmt: skip
        state = jax.vmap(arena.step)(state, actions)
        data = state.physics.carry.data
        where, slots = data._impl.contact__worldid, jnp.arange(data._impl.contact__worldid.shape[-1])
        contacts = jnp.zeros(number, jnp.int32).at[where].add(slots < data._impl.nacon.max(), mode="drop")
        xpos, xmat = jax.lax.optimization_barrier((data.geom_xpos, data.geom_xmat))
        need = {"pairs": pairs(xpos, xmat), "contacts": contacts, "rows": data._impl.nefc}
        return state, need | {"pool": data._impl.ncollision.max()}

    @jax.jit
    def episode(stacks: dict[str, PolicyStack], state: State, key: Array) -> tuple[State, dict[str, Array]]:
        return jax.lax.scan(lambda s, k: decision(stacks, s, k), state, jax.random.split(key, decisions))

    def played(stacks: dict[str, PolicyStack], state: State, key: Array) -> tuple[State, dict[str, np.ndarray]]:
        after, needs = episode(stacks, state, key)
        return after, jax.device_get(needs)

    return played


def put(arena: Arena, state: State, start: Array) -> State:
    """Return the world with its robots moved to a start, given by its index in STARTS; game and props stay."""
    bases = np.array([at.qpos for at in arena.scene.agents.values()])
    qpos = state.physics.qpos
    xy = qpos[bases[:, None] + np.arange(2)]
    apart = jnp.linalg.norm(xy[:, None] - xy[None], axis=-1) + 1e9 * jnp.eye(len(bases))
    share = jnp.minimum(1.0, BETWEEN / apart.min()) if len(bases) > 1 else 1.0
    close = qpos.at[bases[:, None] + np.arange(2)].set(xy.mean(0) + share * (xy - xy.mean(0)))
    qpos = jnp.where(start >= 2, close, qpos)
    half = np.where(np.arange(len(bases)) % 2, np.pi / 4, np.pi / 2)  # on the side, or on the back
    lying = jnp.array([[np.cos(h), np.sin(h), 0.0, 0.0] for h in half])
    rest = np.array([robot.rest_height for robot in arena.robots.values() if robot.build])
    down = qpos.at[bases[:, None] + 3 + np.arange(4)].set(lying).at[bases + 2].set(rest + 0.1)
    qpos = jnp.where(start % 2 == 1, down, qpos)
    physics = arena.engine.place(state.physics, qpos, jnp.zeros_like(state.physics.qvel), start > 0)
    return state._replace(physics=physics)


def players_of(arena: Arena, policies: int, quick: bool) -> dict[str, dict[str, Any]]:
    """Return the players of each group of worlds: name -> agent -> policy, or the number of a script."""
    config = HappoConfig()
    found: dict[str, dict[str, Any]] = {}
    for i in range(policies):
        actors = [
            Actor(a.observation_size, a.action_size, config.architecture, config.initial_std) for a in arena.agents
        ]
        policies_of = jax.device_put(to_jax([actor.state_dict() for actor in actors]), jax.devices()[0])
        found[f"untrained-{i}"] = dict(zip((a.name for a in arena.agents), policies_of, strict=True))
    names = ["random"] if quick else list(arena.scripts())
    for name in names:
        number = {
            a.name: list(scripts_for(arena, a.kind)).index(name)
            for a in arena.agents if name in scripts_for(arena, a.kind)
        }  # fmt: skip
        idle = {a.name: list(scripts_for(arena, a.kind)).index("random") for a in arena.agents}
        found[name] = idle | number
    shipped = {} if quick else trained(arena)
    return found | ({"trained": {**found["random"], **shipped}} if shipped else {})


def trained(arena: Arena) -> dict[str, Any]:
    """Return policies that come with the league, by the agents that they fit."""
    found: dict[str, Any] = {}
    for path in sorted(TRAINED.glob("*.safetensors")):
        tensors = arrays.from_bytes(path.read_bytes())
        kind = path.stem.partition("-")[0].rstrip("s")
        for team in arena.teams:
            for i, agent in enumerate(team.agents):
                own = {k.removeprefix(f"{i}/"): v for k, v in tensors.items() if k.startswith(f"{i}/")}
                if own and agent.kind == kind and sizes(own) == (agent.observation_size, agent.action_size):
                    found.setdefault(agent.name, policy_params(own))
    return found


def sizes(policy: dict[str, np.ndarray]) -> tuple[int, int]:
    """Return the sizes of a policy's observation and action."""
    return policy["trunk.observation_mean"].shape[0], policy["mean.bias"].shape[0]


def cost(name: str, worlds: int, own: Solver, decisions: int = 64, repeats: int = 4) -> dict:
    """Return steps/s of untrained rollouts with these buffers and with those of 57ed746, and their ratio."""
    contacts, rows = BEFORE.get(name, (own.contacts, own.rows))
    sides = {"now": own, "before": Solver(contacts=contacts, spare=0, rows=rows)}
    took: dict[str, list[float]] = {side: [] for side in sides}
    running = {}
    for side, buffers in sides.items():
        arena = arenas.load(name, engine="warp", worlds=worlds)
        engine = arena.engine
        arena.engine = MjxEngine(
            engine.model, engine.derived, engine.pushed, impl="warp", worlds=worlds, buffers=buffers
        )
        arena.engine.prepare()()
        stacks = {a: stack_policies([p]) for a, p in players_of(arena, 1, True)["untrained-0"].items()}
        rollout = make_rollout(arena, decisions)
        now = make_reset(arena)(jax.random.split(jax.random.key(0), worlds))
        now, _ = jax.block_until_ready(rollout(stacks, now, jax.random.key(1)))
        running[side] = [rollout, stacks, now, worlds * decisions * arena.timing.hold]
    for i in range(repeats):
        for side, (rollout, stacks, now, _) in running.items():
            began = time.perf_counter()
            running[side][2], _ = jax.block_until_ready(rollout(stacks, now, jax.random.key(2 + i)))
            took[side].append(time.perf_counter() - began)
    rate = {side: running[side][3] / float(np.median(took[side])) for side in sides}
    ratios = np.divide(took["before"], took["now"])
    return {
        "worlds": worlds, "steps_per_second": {side: round(r) for side, r in rate.items()},
        "ratio": {"median": round(float(np.median(ratios)), 4), "least": round(float(ratios.min()), 4),
                  "most": round(float(ratios.max()), 4)},
    }  # fmt: skip


def summary(found: dict) -> dict:
    """Return what fits a line: buffers, need and headroom of each number of worlds, voids and cost."""

    def line(of: dict) -> dict:
        pool, rows = of["pool"], of["rows"]
        return {
            "pairs": pool["pairs"], "slots": pool["slots"], "headroom": round(pool["slots"] / max(1, pool["pairs"]), 2),
            "rows": f"{rows['most']}/{rows['each']}", "void": of["void"], "slots_needed": of["slots"],
        }  # fmt: skip

    return {**found, "worlds": {n: line(of) for n, of in found["worlds"].items()}}


if __name__ == "__main__":
    main()
