"""How few substeps of physics a control step of sumo may have: where it ends, and whether trained robots still win.

    python benchmarks/substeps.py --out benchmarks/results/substeps-cpu.json

On the C engine. `ends`: the policies that come with the league play `sumo-by-team` in `--worlds` worlds; from
`--moments` moments of that play each world makes one control step of 20 substeps, and one of fewer under the same
command. Told are the median, 95th and 99.9th percentile of the gaps between the two, over all robots: of the base, of
which way it is turned (the angle), and of the joint of an ANYmal that is off most. `matches`: wins, draws and losses of
`--worlds` matches of trained policies with so many substeps; they learnt with four.
"""

import argparse
import sys
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

# Not this folder, whose arenas.py would hide the package of that name.
sys.path[0] = str(Path(__file__).resolve().parents[1])

from league.environment import prepare  # noqa: E402

prepare()  # before jax reads the environment

import jax  # noqa: E402
import numpy as np  # noqa: E402
from jax import Array  # noqa: E402

from agents.rollout import make_reset, make_rollout  # noqa: E402
from arenas.arena import Arena  # noqa: E402
from arenas.sumo import stages  # noqa: E402
from benchmarks.record import commit, machine, tell  # noqa: E402
from league.config import experiment as configuration  # noqa: E402
from league.config.experiment import Config  # noqa: E402
from league.evaluate import Referee  # noqa: E402
from league.jobs import RatingMatch  # noqa: E402
from league.policies import seat, thaw  # noqa: E402
from league.prepare import create  # noqa: E402
from league.versions import versions  # noqa: E402
from storage.store import Store  # noqa: E402

CONTROL, TRUE, TRIED = 0.02, 20, (8, 4, 3, 2)  # s; substeps of a control step
SIDES = ("anymals-sumo", "leatherbacks-sumo")
MATCHES: tuple[tuple[str, str, str | None], ...]
MATCHES = (("anymal-walk", "anymal-walk", None), ("block-push-anymal", "anymal-push", "idle"), ("sumo-by-team", *SIDES))
WARM, APART = 100, 20  # decisions before the first moment, and between two

States = list[tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]]  # qpos and qvel (N, ...), actions by agent


def main() -> None:
    """Measure both and write the JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=128)
    parser.add_argument("--moments", type=int, default=30)
    parser.add_argument("--matches", type=int, nargs="*", default=[4, 3, 2], help="with so many substeps")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    result = {
        "command": " ".join(["python", *sys.argv]), "commit": commit(), "machine": machine(), "versions": versions(),
        "states": args.worlds * args.moments, "ends": ends(args.worlds, args.moments), "matches": [],
    }  # fmt: skip
    tell(result, args.out)
    for (name, policy, other), substeps in product(MATCHES, args.matches):
        about = {"arena": name, "policy": policy, "against": other, "substeps": substeps}
        result["matches"].append(about | match(name, policy, other, substeps, args.worlds))
        tell(result, args.out)


def settings(name: str, substeps: int, worlds: int) -> Config:
    """The default league in an arena of sumo, its control step of so many substeps."""
    config = configuration.default(name)
    if name == "sumo-by-team":
        rules = replace(config.arena.rules, timestep=CONTROL / substeps)  # type: ignore
        config = replace(config, arena=replace(config.arena, rules=rules))  # type: ignore
    stages.TIMESTEP = CONTROL / substeps  # that of walk and push, where it is no setting
    return replace(config, rating=replace(config.rating, worlds=worlds, pairings=1, record=False))


def ends(worlds: int, moments: int) -> dict[str, dict]:
    """Of each number of substeps how far its control steps end from those of `TRUE`."""
    played = states(worlds, moments)
    true = after(TRUE, played, worlds)
    return {str(n): gaps(after(n, played, worlds), true) for n in TRIED}


def states(worlds: int, moments: int) -> States:
    """Moments of trained play, a world each."""
    config = settings("sumo-by-team", TRIED[2], worlds)
    arena = config.arena.build(engine="c", worlds=worlds)
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, arena)
        named = {snapshot.name: snapshot for snapshot in store.snapshots(config.league)}
        crews = seat(arena.teams, [[thaw(store, named[name], arena)] for name in SIDES])
    rollout = make_rollout(arena, APART)
    now, found = make_reset(arena)(jax.random.split(jax.random.key(0), worlds)), []
    for i in range(WARM // APART + moments):
        start = jax.device_get((now.state.physics.qpos, now.state.physics.qvel))
        now, trajectory = rollout(crews, now, jax.random.key(i))
        found.append((*start, {name: np.asarray(actions[0]) for name, actions in trajectory.actions.items()}))
    return found[-moments:]


def after(substeps: int, played: States, worlds: int) -> list[dict[str, np.ndarray]]:
    """Of each robot where it is after a control step from all these states, as `of` has it."""
    arena = settings("sumo-by-team", substeps, worlds).arena.build(engine="c", worlds=worlds)

    def step(qpos: Array, qvel: Array, actions: dict[str, Array]) -> Array:
        physics = arena.engine.make(qpos, qvel)
        return arena.engine.step(physics, arena.command(actions), arena.timing.substeps, arena.law).qpos

    run = jax.jit(jax.vmap(step))
    qpos = np.concatenate([np.asarray(run(*state)) for state in played])
    return [of(arena, name, qpos) for name in arena.scene.agents]


def of(arena: Arena, agent: str, qpos: np.ndarray) -> dict[str, np.ndarray]:
    """A robot's base (n, 3) m, quaternion (n, 4) and, of an ANYmal, joints (n, 12) rad."""
    at, legs = arena.scene.agents[agent], arena.robots[agent].kind == "anymal"
    found = {"base_m": qpos[:, at.qpos : at.qpos + 3], "turned_rad": qpos[:, at.qpos + 3 : at.qpos + 7]}
    return found | ({"joint_rad": qpos[:, at.joint_qpos]} if legs else {})


def gaps(ours: list[dict[str, np.ndarray]], true: list[dict[str, np.ndarray]]) -> dict[str, list[float]]:
    """Percentiles 50, 95 and 99.9 of all robots' gaps."""
    between = {
        "base_m": lambda a, b: np.linalg.norm(a - b, axis=1),
        "turned_rad": lambda a, b: 2 * np.linalg.norm(a - b, axis=1),  # of unit quaternions: the angle, where small
        "joint_rad": lambda a, b: np.abs(a - b).max(axis=1),
    }
    found = {
        name: np.concatenate([gap(a[name], b[name]) for a, b in zip(ours, true, strict=True) if name in a])
        for name, gap in between.items()
    }
    return {name: [float(f"{x:.3g}") for x in np.percentile(each, [50, 95, 99.9])] for name, each in found.items()}


def match(name: str, policy: str, other: str | None, substeps: int, worlds: int) -> dict[str, int]:
    """Matches, or an attempt in each world, of a policy that comes with the league."""
    config = settings(name, substeps, worlds)
    arena = config.arena.build(engine="c", worlds=worlds)
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, arena)
        job = RatingMatch(((policy, other),), 1, record=False)
        (found,) = Referee(config, arena, config.league).play(store, job)
    return {"wins": found.wins, "draws": found.draws, "losses": found.losses, "voids": found.voids}


if __name__ == "__main__":
    main()
