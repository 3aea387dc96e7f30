"""The velocity task of mjlab's Go1 as terms of an arena: its rewards, for walking towards the enemy.

Configuration and reward functions are mjlab's own, imported from the installed package and called on the host, in
torch, for all worlds at once.
"""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import torch
from mjlab.tasks.velocity.config.go1.env_cfgs import unitree_go1_flat_env_cfg

from arenas.robots.rotations import into_body, yaw

TASK = unitree_go1_flat_env_cfg()
ARTICULATION = TASK.scene.entities["robot"].articulation
TWIST = TASK.commands["twist"]
TERMS = ("track_linear_velocity", "track_angular_velocity", "upright", "pose", "dof_pos_limits")
SPEED = 1.0  # m/s towards the enemy, the most that mjlab's first stage commands
KIND = "go1"  # robots that have the task
DOWN = (0.0, 0.0, -1.0)


def command(arena, agent, physics, game, actions):
    """Return mjlab's command (3,) for walking to the enemy: m/s ahead, m/s to the left, rad/s of yaw."""
    own = arena.body(agent, physics, actions).pose
    enemies = [a for team in arena.teams for a in team.agents if agent not in [mate.name for mate in team.agents]]
    away = arena.body(enemies[0].name, physics, actions).pose[:2] - own[:2]
    angle = jnp.arctan2(away[1], away[0]) - yaw(own[3:])
    angle = jnp.arctan2(jnp.sin(angle), jnp.cos(angle))
    turn = jnp.clip(TWIST.heading_control_stiffness * angle, *TWIST.ranges.ang_vel_z)
    return jnp.stack([SPEED * jnp.cos(angle), SPEED * jnp.sin(angle), turn])


def reward(name):
    """Return the term of this name of mjlab's task as a function of an arena."""
    settings = TASK.rewards[name]

    def term(arena, before, physics, game):
        """Return for each team, for one control step, the mean over its robots that have the task: (teams,)."""
        found = []
        for team in arena.teams:
            values = [value(settings, arena, agent.name, physics, game) for agent in team.agents if agent.kind == KIND]
            found.append(jnp.stack(values).mean() if values else jnp.zeros(()))
        return jnp.stack(found) * settings.weight * arena.timing.control_interval

    return term


def value(settings, arena, agent, physics, game):
    """Return the value () of a term for one robot, computed by mjlab on the host."""
    nothing = {name: jnp.zeros(robot.action_size) for name, robot in arena.robots.items()}
    body, robot = arena.body(agent, physics, nothing), arena.robots[agent]
    quat = body.pose[3:]
    state = {
        "quat": quat, "linear": into_body(quat, body.velocity[:3]), "angular": body.velocity[3:],
        "down": into_body(quat, jnp.array(DOWN)), "angles": body.angles, "speeds": body.speeds,
        "command": command(arena, agent, physics, game, nothing),
    }  # fmt: skip
    limits = [arena.scene.model.joint(f"{agent}/{joint}").range for joint in robot.joints]

    def on_host(given):
        shape = given["quat"].shape[:-1]
        rows = {k: torch.from_numpy(np.array(v, np.float32)).reshape(-1, v.shape[-1]) for k, v in given.items()}
        env = environment(rows, robot, np.array(limits))
        function = settings.func(settings, env) if isinstance(settings.func, type) else settings.func
        return function(env, **settings.params).numpy().reshape(shape).astype(np.float32)

    return jax.pure_callback(on_host, jax.ShapeDtypeStruct((), jnp.float32), state, vmap_method="broadcast_all")


def environment(rows, robot, limits):
    """Return what mjlab's functions read of an environment, for rows of worlds."""
    middle, half = limits.mean(axis=1), np.ptp(limits, axis=1) / 2 * ARTICULATION.soft_joint_pos_limit_factor
    soft = np.stack([middle - half, middle + half], axis=1).astype(np.float32)
    data = SimpleNamespace(
        root_link_lin_vel_b=rows["linear"], root_link_ang_vel_b=rows["angular"], root_link_quat_w=rows["quat"],
        body_link_quat_w=rows["quat"][:, None], projected_gravity_b=rows["down"],
        gravity_vec_w=torch.tensor(DOWN).expand(len(rows["quat"]), 3), joint_pos=rows["angles"],
        joint_vel=rows["speeds"], default_joint_pos=torch.tensor(robot.rest)[None],
        soft_joint_pos_limits=torch.from_numpy(soft)[None],
    )  # fmt: skip
    joints = list(range(len(robot.joints))), list(robot.joints)
    return SimpleNamespace(
        scene={"robot": SimpleNamespace(data=data, find_joints=lambda names: joints)}, device="cpu",
        command_manager=SimpleNamespace(get_command=lambda name: rows["command"]),
    )  # fmt: skip


globals().update({name: reward(name) for name in TERMS})
