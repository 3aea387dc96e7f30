"""A match of two cars, stepped by MuJoCo, as a recording."""

import mujoco
import numpy as np

from storage.recordings.recording import Recording, RecordingHeader, from_bytes, to_bytes
from storage.records import ArenaKey

STEPS = 100


def car(team: str, x: float, yaw: float, rgba: str) -> str:
    wheels = "".join(
        f'<geom type="cylinder" size=".1 .04" pos="{i * 0.2} {j * 0.22} -.06" euler="90 0 0" rgba=".1 .1 .1 1"/>'
        for i in (-1, 1)
        for j in (-1, 1)
    )
    return f"""
    <body name="{team}/0/chassis" pos="{x} 0 .17" euler="0 0 {yaw}">
      <freejoint/>
      <geom type="box" size=".3 .18 .08" mass="5" rgba="{rgba}"/>
      <geom name="{team}/0/bumper" type="capsule" size=".04 .15" pos=".3 0 0" euler="90 20 0" material="{team}"/>
      <geom type="mesh" mesh="fin" pos="-.1 0 .2" euler="0 30 0" mass="0" rgba=".9 .9 .9 1"/>
      <geom type="box" size=".5 .5 .5" group="3" mass="0" contype="0" conaffinity="0" rgba="0 1 0 1"/>
      {wheels}
      <body name="{team}/0/mast" pos="0 0 .2"><joint axis="1 0 0"/><geom type="sphere" size=".05" mass=".1"/></body>
    </body>"""


XML = f"""
<mujoco>
  <option timestep=".005"/>
  <asset>
    <mesh name="fin" vertex="0 0 0  .2 0 0  0 .1 0  0 0 .3"/>
    <material name="blue" rgba=".1 .3 1 1"/><material name="red" rgba="1 .1 .1 1"/>
  </asset>
  <worldbody>
    <geom type="plane" size="0 0 1" rgba=".3 .33 .37 1"/>
    <body name="post" pos="3 3 0"><geom type="ellipsoid" size=".1 .1 .4"/></body>
    {car("blue", -1, 0, ".16 .42 .9 1")}
    {car("red", 1, 180, ".88 .22 .2 1")}
  </worldbody>
</mujoco>"""


def cars() -> Recording:
    """Two cars roll at each other for two seconds inside a ring that shrinks from 2 m to 1.2 m."""
    model = mujoco.MjModel.from_xml_string(XML)
    data = mujoco.MjData(model)
    data.qvel[[0, 7]] = 2.5, -1.5
    time_, qpos = [], []
    for _ in range(STEPS):
        mujoco.mj_step(model, data, 4)
        time_.append(data.time)
        qpos.append(data.qpos.copy())
    n, radius = np.arange(STEPS), np.linspace(2, 1.2, STEPS)
    recording = Recording(
        header=RecordingHeader(
            league="demo",
            match=12,
            seed=5,
            world=0,
            arena=ArenaKey("sumo", "c0ffee", "c"),
            sides=("blue@16", "red@8"),
            digests=("ab", "cd"),
            teams=("blue", "red"),
            agents=(("blue/0",), ("red/0",)),
            score=(1.0, 0.0),
            outcome="win blue",
            dt=0.02,
            marker_kinds={"ring": "circle"},
        ),
        xml=XML,
        time=np.array(time_),
        qpos=np.array(qpos),
        actions={"blue/0": np.zeros((STEPS, 2)), "red/0": np.zeros((STEPS, 2))},
        reward=np.stack([np.sin(n / 9), -np.sin(n / 9)], axis=1),
        score=np.stack([n > 60, n < 0], axis=1),
        markers={"ring": np.stack([0 * radius, 0 * radius, radius], axis=1)},
        events=[(30, "contact"), (60, "red/0 leaves the ring"), (80, "contact")],
        terms={"push": np.stack([n / STEPS, -n / STEPS], axis=1), "effort": np.full((STEPS, 2), -0.25)},
        values={"blue": np.cos(n / 9)},
    )
    return from_bytes(to_bytes(recording))
