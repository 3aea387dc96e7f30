"""Time until a humanoid falls in gusts of wind that it has never met (Bansal et al. 2018, Table 2).

    python -m experiments.wind OUT --arena sumo-humanoids --player blue --out experiments/results/wind-sumo-cpu.json
    python -m experiments.wind WALKER --arena walk --player blue --out FILE -- --arena.blue=humanoid

OUT has a folder for each seed, see `experiments/policy_files.py`; arguments after `--` are further settings of the
arena, as flags of `league run`. Every 0.75 s, 50 of their steps of 15 ms, a force of F newtons in a random horizontal
direction begins to push the torso and decays by 0.9 a step. An episode lasts 7.5 s, 500 of their steps; a base below
`--height` has fallen. Published, means of 200 episodes and standard deviations, in their steps:

| F | 200 | 300 | 400 | 500 | 600 |
|---|---|---|---|---|---|
| learnt sumo | 372 ± 146 | 327 ± 150 | 247 ± 143 | 181 ± 114 | 123 ± 57 |
| learnt to walk | 179 ± 54 | 139 ± 42 | 116 ± 32 | 103 ± 23 | 95 ± 20 |

Theirs does not say what the sumo agent sees of an opponent. Here every other robot is seen where the episode began,
and cannot be touched: its body is moved aside. The C engine steps; actions are the means of the policies.
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.physics.engine import Physics
from arenas.physics.mujoco_c import CEngine
from experiments.policy_files import SUFFIX, config_of, file_league
from league.commands.cli import guarded
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.queries.query import Open
from league.snapshots.policy_callable import policy_callable
from scripts.record import make_parser, run_info, split_arguments, write

STEP, STEPS = 0.015, 500  # seconds of a step of Bansal et al., and steps of an episode
GUST, DECAY = 50, 0.9  # their steps between two gusts, and what is left of a force after a step
ASIDE = 50.0  # m by which the bodies of other robots are moved

Policy = Callable[[np.ndarray], np.ndarray]


class World(NamedTuple):
    """A world in the wind; `seen` is (qpos, qvel) as it began, where other robots stay in observations."""

    physics: Physics
    game: Any
    seen: tuple[Array, Array]


class WindyArena:
    """An arena in which wind pushes one agent; the rules of its game decide nothing."""

    def __init__(self, arena: Arena, agent: str, body: str):
        """Prepare the physics. Raises ConfigError if the agent has no such body."""
        names = [arena.scene.model.body(i).name for i in range(1, arena.scene.model.nbody)]
        own = [name.removeprefix(f"{agent}/") for name in names if name.startswith(f"{agent}/")]
        if body not in own:
            raise ConfigError(("body",), f"{agent} has no body {body!r}: (bodies: {', '.join(own)})")
        self.arena, self.agent = arena, agent
        pushed = (arena.scene.model.body(f"{agent}/{body}").id,)
        self.engine = CEngine(arena.scene.model, arena.engine.derived, pushed)
        self.place, self.observe, self.step = (
            jax.jit(jax.vmap(each)) for each in (self._place, self._observe, self._step)
        )

    @property
    def dt(self) -> float:
        """Seconds of a decision."""
        return self.arena.timing.decision_interval

    def _place(self, key: Array) -> World:
        qpos, qvel, game = self.arena.place(key)
        aside = qpos
        for agent, at in self.arena.scene.agents.items():
            if agent != self.agent:
                aside = aside.at[at.own_qpos[0]].add(ASIDE)
        return World(self.engine.make(aside, qvel), game, (qpos, qvel))

    def _observe(self, world: World, action: Array) -> Array:
        physics, (qpos, qvel) = world.physics, world.seen
        at = self.arena.scene.agents[self.agent]
        qpos = qpos.at[at.own_qpos].set(physics.qpos[at.own_qpos])
        qvel = qvel.at[at.own_qvel].set(physics.qvel[at.own_qvel])
        return self.arena.observe(physics._replace(qpos=qpos, qvel=qvel), world.game, self._all(action))[self.agent]

    def _step(self, world: World, action: Array, force: Array) -> tuple[World, Array]:
        """Return the world after a decision under a force (3,) in N, and the height of the base in m."""
        timing, push = self.arena.timing, jnp.concatenate([force, jnp.zeros(3)])[None]
        physics, command = world.physics._replace(push=push), self.arena.command(self._all(action))
        for _ in range(timing.hold):
            physics = self.engine.step(physics, command, timing.substeps, self.arena.law)
        height = self.arena.scene.agents[self.agent].pose(physics.qpos)[2]
        return world._replace(physics=physics), height

    def _all(self, action: Array) -> dict[str, Array]:
        zeros = {name: jnp.zeros(robot.action_size) for name, robot in self.arena.robots.items()}
        return {**zeros, self.agent: action}


def gusts(dt: float, force: float, episodes: int, rng: np.random.Generator) -> np.ndarray:
    """Return the forces (decisions, episodes, 3) in N of episodes with decisions of `dt` seconds."""
    times = np.arange(round(STEP * STEPS / dt)) * dt
    number, since = np.divmod(times / STEP + 1e-9, GUST)  # the first gust comes after GUST steps
    angles = rng.uniform(0, 2 * np.pi, (int(number.max()) + 1, episodes))[number.astype(int)]
    size = np.where(number > 0, force * DECAY**since, 0.0)[:, None]
    return np.stack([size * np.cos(angles), size * np.sin(angles), np.zeros_like(angles)], axis=-1)


def fall_times(windy: WindyArena, policy: Policy, forces: np.ndarray, height: float, seed: int) -> np.ndarray:
    """Return the seconds (episodes,) until the base is first below a height in m; those of an episode if it stands."""
    episodes = forces.shape[1]
    world = windy.place(jax.random.split(jax.random.key(seed), episodes))
    action = jnp.zeros((episodes, windy.arena.robots[windy.agent].action_size))
    fell = np.full(episodes, STEP * STEPS)
    for number, force in enumerate(forces):
        action = jnp.asarray(policy(np.asarray(windy.observe(world, action))))
        world, heights = windy.step(world, action, jnp.asarray(force, jnp.float32))
        down = ~(np.asarray(heights) >= height)  # a number that is none has fallen too
        fell[down] = np.minimum(fell[down], (number + 1) * windy.dt)
        if (fell <= number * windy.dt).all():
            break
    return fell


def row(fell: np.ndarray, force: float) -> dict[str, float]:
    """Return what JSON has of the episodes under one force."""
    steps, stood = fell / STEP, float((fell >= STEP * STEPS - 1e-6).mean())
    return {
        "force": force, "episodes": len(fell), "mean_steps": round(float(steps.mean()), 1),
        "deviation": round(float(steps.std(ddof=1)), 1), "standing": round(stood, 3),
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Push every policy and print a row for each force."""
    args, config, seeds = parsed(sys.argv[1:] if argv is None else argv)
    found: list[dict[str, Any]] = []
    with file_league(config, args.folder, seeds, (args.player,), 2) as files:
        windy = WindyArena(files.arena, f"{args.player}/0", args.body)
        for seed in seeds:
            policy = policy_callable(Open(files.store, config.league), f"{seed}:{args.player}")
            for force in (0.0, *args.forces):
                forces = gusts(windy.dt, force, args.episodes, np.random.default_rng([args.seed, int(force)]))
                policy.reset()
                found.append({"seed": seed, **row(fall_times(windy, policy, forces, args.height, args.seed), force)})
                print(json.dumps(found[-1]), flush=True)
        about = {**run_info(args.commit), "arena": args.arena, "policies": files.policies(), "rows": found}
    write(about, args.out)
    return 0


def parsed(argv: Sequence[str]) -> tuple[argparse.Namespace, Config, list[str]]:
    """Return the arguments, the configuration of the arena, and the names of the seeds' folders."""
    own, further = split_arguments(list(argv))
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, help="OUT, with a folder of policies for each seed")
    parser.add_argument("--arena", required=True)
    parser.add_argument("--player", required=True, help="whose policies play; its team has the same name")
    parser.add_argument("--seeds", nargs="+", help="names of those folders (default: all)")
    parser.add_argument("--body", default="torso", help="the body that the wind pushes")
    parser.add_argument("--forces", type=float, nargs="+", default=[200.0, 300.0, 400.0, 500.0, 600.0], help="in N")
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--height", type=float, default=1.0, help="m, as in gymnasium's humanoid")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(own)
    config = config_of(parser, args.arena, further)
    seeds = args.seeds or sorted(path.parent.name for path in args.folder.glob(f"*/{args.player}{SUFFIX}"))
    if not seeds:
        parser.error(f"{args.folder} has no folder with a {args.player}{SUFFIX}")
    return args, config, seeds


if __name__ == "__main__":
    sys.exit(guarded(main))
