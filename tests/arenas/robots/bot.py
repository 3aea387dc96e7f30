"""A quadruped of eight joints as MJCF and URDF text, for tests of robots from files."""

LEGS = {"fl": (0.2, 0.1), "fr": (0.2, -0.1), "hl": (-0.2, 0.1), "hr": (-0.2, -0.1)}
_LEG = """
<body name="{leg}_thigh" pos="{x} {y} 0"><joint name="{leg}_hip" axis="0 1 0" range="-1 1" actuatorfrcrange="-20 20"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".5"/>
<body name="{leg}_shank" pos="0 0 -.2"><joint name="{leg}_knee" axis="0 1 0" range="-2 0" actuatorfrcrange="-20 20"/>
<geom type="sphere" pos="0 0 -.2" size=".03" mass=".2"/></body></body>"""
_LINK = """
<link name="{leg}_thigh"><inertial><origin xyz="0 0 -.1"/><mass value=".5"/>
<inertia ixx=".002" iyy=".002" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{leg}_hip" type="revolute"><parent link="base"/><child link="{leg}_thigh"/><origin xyz="{x} {y} 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="20" velocity="10"/></joint>
<link name="{leg}_shank"><inertial><origin xyz="0 0 -.1"/><mass value=".2"/>
<inertia ixx=".001" iyy=".001" izz=".0005" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 -.2"/><geometry><sphere radius=".03"/></geometry></collision></link>
<joint name="{leg}_knee" type="revolute"><parent link="{leg}_thigh"/><child link="{leg}_shank"/>
<origin xyz="0 0 -.2"/><axis xyz="0 1 0"/><limit lower="-2" upper="0" effort="20" velocity="10"/></joint>"""


def mjcf(actuators: str = "", free: str = "<freejoint/>", extra: str = "", knees: tuple[str, ...] = tuple(LEGS)) -> str:
    """Return the model with a floor, a light and a camera; `actuators` is the format of one by its `{joint}`."""
    legs = "".join(_LEG.format(leg=leg, x=x, y=y) for leg, (x, y) in LEGS.items())
    joints = [f"{leg}_hip" for leg in LEGS] + [f"{leg}_knee" for leg in knees]
    motors = "".join(actuators.format(joint=joint) for joint in joints)
    hull = '<geom type="box" size=".2 .1 .05" mass="5" contype="1" conaffinity="0"/>'
    return f"""<mujoco><compiler angle="radian"/><option timestep=".001"/><worldbody>
<geom type="plane" size="5 5 .1" friction=".7"/><light pos="0 0 3"/><camera pos="1 1 1"/>
<body name="base" pos="0 0 .6">{free}{hull}{legs}</body>
</worldbody><actuator>{motors}</actuator>{extra}</mujoco>"""


def cart() -> str:
    """Return a robot on two wheels, one of whose axles points backwards, and two sliding balls."""
    ball = '<geom type="sphere" size=".02" pos="{x} 0 -.05" friction=".05 .005 .0001" mass=".1"/>'
    wheel = (
        '<body pos="0 {y} 0"><joint name="{name}" axis="0 {axis} 0"/><geom type="sphere" size=".07" mass=".2"/></body>'
    )
    parts = [ball.format(x=x) for x in (0.17, -0.17)]
    parts += [wheel.format(name="left", y=0.16, axis=1), wheel.format(name="right", y=-0.16, axis=-1)]
    motors = "".join(f'<velocity joint="{name}" kv=".2" ctrlrange="-40 40"/>' for name in ("left", "right"))
    return f"""<mujoco><worldbody><body name="cart" pos="0 0 .1"><freejoint/>
<geom type="box" size=".2 .12 .05" mass="3"/>{"".join(parts)}</body></worldbody>
<actuator>{motors}</actuator></mujoco>"""


def urdf() -> str:
    """Return the same legs and base, whose drawing is a mesh that does not exist."""
    links = "".join(_LINK.format(leg=leg, x=x, y=y) for leg, (x, y) in LEGS.items())
    return f"""<robot name="bot"><link name="base"><inertial><mass value="5"/>
<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="package://bot/base.stl"/></geometry></visual>
<collision><geometry><box size=".4 .2 .1"/></geometry></collision></link>{links}</robot>"""
