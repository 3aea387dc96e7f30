"""Smallest number of physics substeps per control step of sumo: where a control step ends, and if robots still win.

    python -m experiments.substeps --out experiments/results/substeps-cpu.json

On the C engine. `ends`: the policies that come with the league play `sumo-by-team` in `--worlds` worlds; from
`--moments` moments of that play each world makes one control step of 20 substeps and one of fewer, with the same
command. The result has the median, 95th and 99.9th percentile of the differences over all robots: base position,
orientation (angle), and the most different joint of an ANYmal. `matches`: wins, draws and losses of `--worlds` matches
of trained policies with each number of substeps; they were trained with four.
"""

import tempfile
from dataclasses import replace
from itertools import product

from league.system.environment import prepare

prepare()  # before jax reads the environment

import jax
import numpy as np
from jax import Array

from agents.rollout.new_worlds import make_reset
from agents.rollout.rollout import make_rollout
from arenas.arena import Arena
from arenas.games.sumo import stages
from league.config import experiment as configuration
from league.config.experiment import Config
from league.matches.evaluator import MatchEvaluator
from league.runtime.preflight import create
from league.snapshots.codec import seat, thaw
from league.state.jobs import RatingMatch
from scripts.record import make_parser, report, run_info
from storage.store import Store

CONTROL, TRUE, TRIED = 0.02, 20, (8, 4, 3, 2)  # s; reference and tested substeps of a control step
SIDES = ("anymals-sumo", "leatherbacks-sumo")
MATCHES: tuple[tuple[str, str, str | None], ...]
MATCHES = (("anymal-walk", "anymal-walk", None), ("block-push-anymal", "anymal-push", "idle"), ("sumo-by-team", *SIDES))
WARM, APART = 100, 20  # decisions before the first moment, and between moments

States = list[tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]]  # qpos and qvel (N, ...), actions by agent


def main() -> None:
    """Measure both and write the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--moments", type=int, default=30)
    parser.add_argument("--matches", type=int, nargs="*", default=[4, 3, 2], help="with these substeps")
    args = parser.parse_args()
    result = {
        **run_info(args.commit), "states": args.worlds * args.moments, "ends": ends(args.worlds, args.moments),
        "matches": [],
    }  # fmt: skip
    report(result, args.out)
    for (name, policy, other), substeps in product(MATCHES, args.matches):
        about = {"arena": name, "policy": policy, "against": other, "substeps": substeps}
        result["matches"].append(about | match(name, policy, other, substeps, args.worlds))
        report(result, args.out)


def settings(name: str, substeps: int, worlds: int) -> Config:
    """Return the default configuration of a sumo arena with this number of substeps per control step."""
    config = configuration.default(name)
    if name == "sumo-by-team":
        rules = replace(config.arena.rules, timestep=CONTROL / substeps)  # type: ignore
        config = replace(config, arena=replace(config.arena, rules=rules))  # type: ignore
    stages.TIMESTEP = CONTROL / substeps  # of walk and push, where it is not a setting
    return replace(config, rating=replace(config.rating, worlds=worlds, pairings=1, record=False))


def ends(worlds: int, moments: int) -> dict[str, dict]:
    """Return the percentiles of differences to `TRUE` for each number of substeps."""
    played = states(worlds, moments)
    true = after(TRUE, played, worlds)
    return {str(n): gaps(after(n, played, worlds), true) for n in TRIED}


def states(worlds: int, moments: int) -> States:
    """Return moments of trained play in all worlds."""
    config = settings("sumo-by-team", TRIED[2], worlds)
    arena = config.arena.build(engine="c", worlds=worlds)
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, arena)
        named = {snapshot.name: snapshot for snapshot in store.snapshots(config.league)}
        stacks = seat(arena.teams, [[thaw(store, named[name], arena)] for name in SIDES])
    rollout = make_rollout(arena, APART)
    now, found = make_reset(arena)(jax.random.split(jax.random.key(0), worlds)), []
    for i in range(WARM // APART + moments):
        start = jax.device_get((now.state.physics.qpos, now.state.physics.qvel))
        now, trajectory = rollout(stacks, now, jax.random.key(i))
        found.append((*start, {name: np.asarray(actions[0]) for name, actions in trajectory.actions.items()}))
    return found[-moments:]


def after(substeps: int, played: States, worlds: int) -> list[dict[str, np.ndarray]]:
    """Return each robot's pose (see `of`) after a control step from all these states."""
    arena = settings("sumo-by-team", substeps, worlds).arena.build(engine="c", worlds=worlds)

    def step(qpos: Array, qvel: Array, actions: dict[str, Array]) -> Array:
        physics = arena.engine.make(qpos, qvel)
        return arena.engine.step(physics, arena.command(actions), arena.timing.substeps, arena.law).qpos

    run = jax.jit(jax.vmap(step))
    qpos = np.concatenate([np.asarray(run(*state)) for state in played])
    return [of(arena, name, qpos) for name in arena.scene.agents]


def of(arena: Arena, agent: str, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """Return a robot's base position (n, 3) in m, quaternion (n, 4) and, of an ANYmal, joints (n, 12) in rad."""
    at, legs = arena.scene.agents[agent], arena.robots[agent].kind == "anymal"
    found = {"base_m": qpos[:, at.qpos : at.qpos + 3], "turned_rad": qpos[:, at.qpos + 3 : at.qpos + 7]}
    return found | ({"joint_rad": qpos[:, at.joint_qpos]} if legs else {})


def gaps(ours: list[dict[str, np.ndarray]], true: list[dict[str, np.ndarray]]) -> dict[str, list[float]]:
    """Return percentiles 50, 95 and 99.9 of the differences over all robots."""
    between = {
        "base_m": lambda a, b: np.linalg.norm(a - b, axis=1),
        "turned_rad": lambda a, b: 2 * np.linalg.norm(a - b, axis=1),  # of unit quaternions: the angle, if small
        "joint_rad": lambda a, b: np.abs(a - b).max(axis=1),
    }
    found = {
        name: np.concatenate([gap(a[name], b[name]) for a, b in zip(ours, true, strict=True) if name in a])
        for name, gap in between.items()
    }
    return {name: [float(f"{x:.3g}") for x in np.percentile(each, [50, 95, 99.9])] for name, each in found.items()}


def match(name: str, policy: str, other: str | None, substeps: int, worlds: int) -> dict[str, int]:
    """Play a match, or an attempt at a stage, in each world with a policy that comes with the league."""
    config = settings(name, substeps, worlds)
    arena = config.arena.build(engine="c", worlds=worlds)
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, arena)
        job = RatingMatch(((policy, other),), 1, record=False)
        (found,) = MatchEvaluator(config, arena, config.league).play(store, job)
    return {"wins": found.wins, "draws": found.draws, "losses": found.losses, "voids": found.voids}


if __name__ == "__main__":
    main()
