"""Milliseconds per control step of rating matches beside those of the training rollout, on one device.

    python -m benchmarks.matches --out benchmarks/results/matches-h200.json

All programs simulate the same worlds with untrained policies: the rollout of training, without learning; a match of one
pairing; a match of `--groups` groups of worlds, each with policies of its own; and the same with scripts in eight
groups, computed one group after the other (`loop`, as on a CPU) or for all groups at once (`together`, as on a GPU).
Prints and writes JSON after each.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import numpy as np

import arenas
from agents.bridge import to_jax
from agents.policy import jax_policy
from agents.policy.jax_policy import Params, PolicyStack, stack_policies
from agents.policy.networks import Actor
from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_rollout, make_stepwise_play, scripts_for
from arenas.arena import Arena
from arenas.state import AgentSpec
from league.config.experiment import default
from scripts.record import make_parser, run_info, write

SCRIPTED = 8  # groups
Stacks = dict[str, PolicyStack]


def main() -> None:
    """Measure, and write the JSON after each program."""
    parser = make_parser(__doc__)
    parser.add_argument("--arena", default="sumo-within-team")
    parser.add_argument("--engine", default="auto")
    parser.add_argument("--worlds", type=int, default=8192)
    parser.add_argument("--groups", type=int, default=64)
    parser.add_argument("--steps", type=int, default=16, help="decisions of a call, as of a time slice of matches")
    parser.add_argument("--repeats", type=int, default=6, help="calls that are timed")
    args = parser.parse_args()
    arena = arenas.load(args.arena, engine=args.engine, worlds=args.worlds)
    arena.engine.prepare()()
    one, many = stacks(arena, 1, scripted=False), stacks(arena, args.groups, scripted=False)
    some = stacks(arena, args.groups, scripted=True)
    usual = jax_policy._each_group
    programs: dict[str, tuple[Callable, Callable[[Arena, Stacks, argparse.Namespace], Callable[[], Any]], Stacks]] = {
        "rollout of training": (usual, rollout, one),
        "match of one pairing": (usual, match, one),
        "match of many groups": (usual, match, many),
        "match with scripts, loop": (jax.lax.map, match, some),
        "match with scripts, together": (lambda function, groups: jax.vmap(function)(groups), match, some),
    }
    found: dict[str, float] = {}
    for name, (each_group, program, policies) in programs.items():
        jax_policy._each_group = each_group
        found[name] = milliseconds(program(arena, policies, args), args) / arena.timing.hold
        about = {"arena": args.arena, "worlds": args.worlds, "groups": args.groups, "steps": args.steps}
        write({**run_info(args.commit), **about, "ms_per_control_step": found}, args.out)
        print(f"{name}: {found[name]:.2f} ms per control step", flush=True)


def milliseconds(call: Callable[[], Any], args: argparse.Namespace) -> float:
    """Return the time of a decision in `call()`, after one call that is not counted."""
    jax.block_until_ready(call())
    began = time.perf_counter()
    for _ in range(args.repeats):
        jax.block_until_ready(call())
    return round(1e3 * (time.perf_counter() - began) / args.repeats / args.steps, 3)


def rollout(arena: Arena, policies: Stacks, args: argparse.Namespace) -> Callable[[], Any]:
    """Return a function that goes on with the training rollout."""
    run, worlds = make_rollout(arena, args.steps), make_reset(arena)(keys(args))

    def call() -> Any:
        nonlocal worlds
        worlds, trajectory = run(policies, worlds, jax.random.key(1))
        return trajectory

    return call


def match(arena: Arena, policies: Stacks, args: argparse.Namespace) -> Callable[[], Any]:
    """Return a function that goes on with a match."""
    begin, go_on = make_stepwise_play(arena, args.steps)
    state = begin(policies, keys(args))

    def call() -> Any:
        nonlocal state
        state, _, over = go_on(policies, state)
        return over

    return call


def keys(args: argparse.Namespace) -> jax.Array:
    """Return a random key for each world."""
    return jax.random.split(jax.random.key(0), args.worlds)


def stacks(arena: Arena, groups: int, *, scripted: bool) -> Stacks:
    """Return untrained policies for each agent, of another seed in each group; the arena's scripts in some groups."""
    made = {}
    for agent in arena.agents:
        policies: list[Params | int] = [untrained(agent) for _ in range(groups)]
        if scripted:
            number = len(scripts_for(arena, agent.kind))
            policies[:SCRIPTED] = [int(i) for i in np.arange(SCRIPTED) % number]
        made[agent.name] = stack_policies(policies)
    return made


def untrained(agent: AgentSpec) -> Params:
    """Return an actor of the default architecture on this device."""
    learner = default().learner
    actor = Actor(agent.observation_size, agent.action_size, learner.architecture, learner.initial_std)
    return jax.device_put(to_jax([actor.state_dict()]), jax.devices()[0])[0]


if __name__ == "__main__":
    main()
