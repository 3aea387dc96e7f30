"""Trial of one robot on flat ground: it stands, moves each joint and flails; mass, contacts and speed are measured.

All runs on MuJoCo's C engine, except `compare`, which steps the same seconds on another engine.
"""

import time
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.batch import Batch

from arenas.arena_settings import EngineName, Solver
from arenas.physics.cpu import cores
from arenas.physics.engine import MAX_SPEED
from arenas.physics.mujoco_c import CEngine, Simulations
from arenas.physics.registry import make_engine
from arenas.robots.files.extents import corners, lowest
from arenas.robots.robot import Robot
from arenas.scene.scene import Scene, build

AGENT = "blue/0"
STEPS = 0.005, 0.01  # s, timesteps of our arenas
STANDS, MOVES, FLAILS = 2.0, 0.4, 4.0  # s
FLAILING, LONG = 32, 20.0  # worlds that flail for so many seconds, where instability is rare
STEADIER = 10, 50  # line-search steps of the solver to try where physics becomes unstable
ACTION = 0.5  # of which joints are moved
LEAST = 0.001  # rad or m: a joint that moves less does not move
NEAR = 0.02  # share of its height by which it may be off the ground at the start
LIGHTEST = 1e-6  # kg·m²: smaller inertias with the motor's own make stiff simulations
CONTROL = 4  # timesteps of a control step
WORLDS, TIMED = 256, 25  # worlds and control steps of the measurement of speed


class Finding(NamedTuple):
    """One check: its name, its outcome and what was measured."""

    name: str
    ok: bool
    detail: str
    mend: str = ""  # what to do about a failure


class Moved(NamedTuple):
    """Motion of a joint under ACTION in MOVES seconds, in rad or m; negative where an action commands the other way."""

    joint: str
    by: float
    ok: bool


class RobotTrial:
    """Trials of one robot; the measured peaks of flailing are in `contacts` and `rows`."""

    def __init__(self, robot: Robot):
        """Build the scene. Raises ArenaError for a robot whose model cannot be built."""
        self.robot = robot
        self.scenes: dict[float, Scene] = {step: build({"blue": [robot]}, timestep=step) for step in STEPS}
        self.model = self.scenes[STEPS[0]].model
        self.contacts = self.rows = 0
        self.rests_after: float | None = None  # s of the zero action until its base touched the ground

    def findings(self) -> Iterator[Finding]:
        """Yield the checks, each when it is done."""
        yield self._mass()
        yield self._placed()
        yield from (self._stand(step) for step in STEPS)
        moved = self.moved()
        still = [each.joint for each in moved if not each.ok]
        detail = f"does not move: {', '.join(still)}" if still else f"{len(moved)}"
        yield Finding("each joint moves", not still, detail, "raise scale or effort, or widen low and high")
        yield self._flail()

    def _data(self, scene: Scene, action: np.ndarray | None = None) -> mujoco.MjData:
        """Return a world at rest with the command of an action (default: zeros)."""
        data = mujoco.MjData(scene.model)
        data.qpos[:] = scene.rest
        self._act(scene, data, np.zeros(self.robot.action_size) if action is None else action)
        return data

    def _act(self, scene: Scene, data: mujoco.MjData, action: np.ndarray) -> None:
        data.ctrl[scene.agents[AGENT].ctrl] = np.asarray(self.robot.command(jnp.asarray(action, jnp.float32)))

    def _mass(self) -> Finding:
        model = self.model
        total = float(model.body_mass.sum())
        of_joints = np.flatnonzero(model.dof_bodyid != self.scenes[STEPS[0]].agents[AGENT].base)
        least = of_joints[np.argmin(model.dof_M0[of_joints])]
        smallest = float(model.dof_M0[least])  # inertia at a joint, with the motor's own
        name = model.joint(int(model.dof_jntid[least])).name.removeprefix(f"{AGENT}/")
        detail = f"{total:.4g} kg in {model.nbody - 1} bodies; least inertia at a joint {smallest:.2g} kg·m² ({name})"
        mend = f"give {name} more armature, or its body more mass"
        return Finding("mass and inertia", total > 0 and smallest > LIGHTEST, detail, mend)

    def _placed(self) -> Finding:
        """Compare its height with that of its lowest point in the standing pose."""
        scene = self.scenes[STEPS[0]]
        data = self._data(scene)
        mujoco.mj_kinematics(scene.model, data)
        bodies = np.flatnonzero(scene.model.body_rootid == scene.agents[AGENT].base)
        touching = (scene.model.geom_contype > 0) & np.isin(scene.model.geom_bodyid, bodies)
        gap = min(lowest(data, int(g)) for g in np.flatnonzero(touching))
        height = self.robot.rest_height - gap
        ok = abs(gap) < NEAR * height
        detail = f"its base is {height:.4g} m above its lowest point"
        wrong = "" if ok else f", but height = {self.robot.rest_height:g}: --fit writes what its pose needs"
        return Finding("placed on the ground", ok, detail + wrong, "let --fit write the height")

    def top(self) -> float:
        """Return the height of its highest shape in the standing pose, m."""
        scene = self.scenes[STEPS[0]]
        data = self._data(scene)
        mujoco.mj_kinematics(scene.model, data)
        return max(float(corners(data, g)[:, 2].max()) for g in range(1, scene.model.ngeom))

    def _stand(self, step: float) -> Finding:
        """Let it stand under the zero action."""
        scene = self.scenes[step]
        data, at = self._data(scene), scene.agents[AGENT]
        start, fell = float(at.pose(data.qpos)[2]), None
        base = np.flatnonzero(scene.model.geom_bodyid == at.base)
        for _ in range(round(STANDS / step)):
            mujoco.mj_step(scene.model, data)
            if fell is None and bool(self.robot.fallen(jnp.asarray(at.pose(data.qpos)))):
                fell = data.time
            if self.rests_after is None and _touch_the_ground(data, base):
                self.rests_after = data.time
        pose = np.asarray(at.pose(data.qpos))
        x, y = pose[4:6]
        tilt = np.degrees(np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1)))
        sound = bool(np.isfinite(data.qpos).all()) and not data.warning.number.any()
        drift = float(np.hypot(pose[0], pose[1]))
        after = f"{start:.3g} m, after {STANDS:g} s {pose[2]:.3g} m, tilt {tilt:.0f}°, drift {drift:.2g} m"
        ends = (
            ""
            if fell is None
            else f"; it has fallen after {fell:.2g} s: the zero action holds no balance (legs want a"
            " bent `home` in the robot file, then `league robot FILE --fit`; a humanoid needs a policy)"
        )
        mend = "bend `home` and let --fit write the pose, or raise kp; a humanoid that needs a policy can play as it is"
        return Finding(f"stands, steps of {step:g} s", sound and fell is None, after + ends, mend)

    def moved(self) -> list[Moved]:
        """Move each joint alone, in the air without gravity, both ways, and return the larger way towards a command."""
        return [self._moved(index) for index in range(self.robot.action_size)]

    def _moved(self, index: int) -> Moved:
        scene = self.scenes[STEPS[0]]
        model, at = scene.model, scene.agents[AGENT]
        ways = []
        gravity = model.opt.gravity.copy()
        model.opt.gravity[:] = 0
        for sign in (1.0, -1.0):
            action = np.zeros(self.robot.action_size)
            action[index] = sign * ACTION
            data = self._data(scene, action)
            data.qpos[at.qpos + (1 if at.planar else 2)] += 10.0
            for _ in range(round(MOVES / STEPS[0])):
                mujoco.mj_step(model, data)
            ways.append(sign * float(data.qpos[at.joint_qpos[index]] - scene.rest[at.joint_qpos[index]]))
        model.opt.gravity[:] = gravity
        commands = [
            np.asarray(self.robot.command(jnp.asarray(each * np.eye(1, len(action), index)[0]))) for each in (-1, 1)
        ]
        turn = float(np.sign(commands[1] - commands[0])[index])
        farthest = max(turn * way for way in ways)
        return Moved(self.robot.joints[index], turn * farthest, farthest > LEAST)

    def _flail(self) -> Finding:
        """Let it flail under random actions, and keep the peaks of contacts and rows."""
        scene, rng = self.scenes[STEPS[0]], np.random.default_rng(0)
        data, at, top = self._data(scene), scene.agents[AGENT], 0.0
        for number in range(round(FLAILS / STEPS[0])):
            if number % CONTROL == 0:
                self._act(scene, data, rng.normal(size=self.robot.action_size))
            mujoco.mj_step(scene.model, data)
            self.contacts, self.rows = max(self.contacts, data.ncon), max(self.rows, data.nefc)
            top = max(top, float(np.abs(at.velocity(data.qvel)[:3]).max()))
        detail = f"at most {self.contacts} contacts, {self.rows} rows; base at most {top:.2g} m/s"
        broken = self.unstable_after()
        if not broken:
            return Finding("flails without breaking", True, detail)
        said = f"unstable in {len(broken)} of {FLAILING} worlds of {LONG:g} s, first after {broken[0]:.2g} s"
        more = [steps for steps in STEADIER if steps > self.model.opt.ls_iterations]
        holds = next((steps for steps in more if not self.unstable_after(steps)), None)
        if holds is None:
            mend = "give light joints more armature, or lower kp, kd, effort or scale"
            tried = f"; ls_iterations = {more[-1]} in the robot file does not help" if more else ""
            return Finding("flails without breaking", False, f"{said}{tried}", mend)
        found = f"{said}; with ls_iterations = {holds} in the robot file, in none"
        return Finding("flails without breaking", False, found, f"set ls_iterations = {holds} in the robot file")

    def unstable_after(self, ls_iterations: int | None = None) -> list[float]:
        """Let it flail in FLAILING worlds, with the solver's own line-search steps or these.

        Return after how many seconds each world's physics became unstable by the arenas' measure, without those that
        stayed sound.
        """
        model = build({"blue": [self.robot]}, timestep=STEPS[0]).model  # its own: the engine changes flags of models
        model.opt.ls_iterations = ls_iterations or model.opt.ls_iterations
        CEngine(model)
        worlds, rng = Simulations(Batch(model, FLAILING, cores()), ()), np.random.default_rng(0)
        worlds.state["qpos"][:] = self.scenes[STEPS[0]].rest
        after = np.full(FLAILING, np.inf)
        command = jax.jit(jax.vmap(self.robot.command))
        for number in range(1, 1 + round(LONG / STEPS[0] / CONTROL)):
            actions = rng.normal(size=(FLAILING, self.robot.action_size)).astype(np.float32)
            worlds.state["ctrl"][:] = command(actions)
            failed = worlds.advance(CONTROL, None, worlds.state["ctrl"])
            failed |= ~(np.abs(worlds.state["qvel"]).max(axis=1) < MAX_SPEED)
            after = np.where(failed, np.minimum(after, number * CONTROL * STEPS[0]), after)
        return sorted(after[np.isfinite(after)].tolist())

    def speed(self) -> float:
        """Return control steps of 0.02 s per second of the C engine on all cores, of a robot that stands."""
        scene = self.scenes[STEPS[0]]
        batch = Batch(scene.model, WORLDS, cores())
        batch.bind("qpos")[:] = scene.rest
        batch.bind("ctrl")[:] = self._data(scene).ctrl
        batch.step(nstep=CONTROL)
        begun = time.perf_counter()
        for _ in range(TIMED):
            batch.step(nstep=CONTROL)
        return WORLDS * TIMED / (time.perf_counter() - begun)

    def compare(self, engine: EngineName, buffers: Solver) -> Finding:
        """Step half a second of standing on another engine and on C, and compare the places of the base.

        Raises EngineError if the engine cannot run here or refuses the model.
        """
        scene, steps = self.scenes[STEPS[0]], 25
        command = jnp.asarray(self._data(scene).ctrl, jnp.float32)
        ends = []
        for name in ("c", engine):
            model = build({"blue": [self.robot]}, timestep=STEPS[0]).model  # its own: engines change flags of models
            stepper = make_engine(name, model, worlds=1, buffers=buffers)
            physics = stepper.make(jnp.asarray(scene.rest, jnp.float32), jnp.zeros(scene.model.nv))
            step = jax.jit(lambda physics, stepper=stepper: stepper.step(physics, command, CONTROL, None, None))
            for _ in range(steps):
                physics = step(physics)
            ends.append(np.asarray(physics.qpos))
        off = float(np.abs(ends[0] - ends[1]).max())
        ok = bool(np.isfinite(off)) and off < 0.01
        mend = "raise contacts and rows in its [buffers], or give light joints more armature"
        return Finding(
            f"engine {engine} agrees with C", ok, f"after {steps * CONTROL * STEPS[0]:g} s within {off:.1g}", mend
        )


def _touch_the_ground(data: mujoco.MjData, geoms: np.ndarray) -> bool:
    """Return whether one of these geoms has a contact with the ground, the scene's first geom."""
    pairs = data.contact.geom  # (contacts, 2)
    return bool(((pairs == 0).any(axis=1) & np.isin(pairs, geoms).any(axis=1)).any())
