"""Numbers of a model that robots from files take over, and those that they do without, which is told."""

from dataclasses import replace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from arenas.contract.robot_trial import RobotTrial
from arenas.robots.files import robot_file as files
from arenas.robots.files.body import build_body
from arenas.robots.files.defaults import derive
from arenas.robots.files.loading import robot_of, source_of
from tests.arenas.robots.bot import LEGS, mjcf

POSITION = '<position joint="{joint}" kp="30" kv="2"/>'


def test_what_an_actuator_loses_is_told(write):
    filtered = '<general joint="{joint}" dyntype="filter" dynprm=".1" ctrlrange="0 3"/>'
    told = ["the activation dynamics of 8 actuators, which act at once here"]
    told += ["the unequal control range of 8 motors: both ways as the wider one"]
    assert source_of(derive(write(mjcf(filtered)))).left_out[3:] == told
    pulls = mjcf(POSITION).replace('actuatorfrcrange="-20 20"', 'actuatorfrcrange="-20 0"')
    pulling = derive(write(pulls + " "))
    assert {drive.effort for drive in pulling.drives.values()} == {20.0}
    assert source_of(pulling).left_out[3:] == ["8 unequal ranges of force: both ways as the wider one"]


def test_the_numbers_that_decide_how_joints_and_bodies_move_are_the_files(write):
    soft = 'frictionloss=".1" solreflimit=".1 1.2" solimplimit="0 .8 .03 .5 2" margin=".05" solreffriction=".07 1"'
    text = mjcf(POSITION).replace('axis="0 1 0"', f'axis="0 1 0" {soft} solimpfriction=".2 .9 .01 .5 2"')
    text = text.replace('actuatorfrcrange="-20 20"', 'actuatorfrcrange="-20 20" actuatorgravcomp="true"')
    text = text.replace('_shank" pos', '_shank" gravcomp=".7" pos')
    source = source_of(settings := derive(write(text)))
    ours = build_body(source, settings, (1, 0, 0, 1)).compile()
    theirs = mujoco.MjModel.from_xml_string(text)
    of_joints = ("jnt_solref", "jnt_solimp", "jnt_margin", "jnt_actgravcomp", "jnt_stiffness", "jnt_range")
    of_dofs = ("dof_solref", "dof_solimp", "dof_damping", "dof_frictionloss", "dof_armature")
    for name in settings.drives:
        here, there = ours.joint(name), theirs.joint(name)
        assert [getattr(ours, each)[here.id].tolist() for each in of_joints] == [
            getattr(theirs, each)[there.id].tolist() for each in of_joints
        ]
        assert [getattr(ours, each)[here.dofadr].tolist() for each in of_dofs] == [
            getattr(theirs, each)[there.dofadr].tolist() for each in of_dofs
        ]
    assert ours.joint("fl_knee").margin == 0.05
    bodies = [ours.body(leg + part).id for leg in LEGS for part in ("_thigh", "_shank")]
    assert ours.body_gravcomp[bodies].tolist() == [0.0, 0.7] * 4


@pytest.mark.parametrize(
    ("actuator", "control", "low", "high"),
    [
        ('<position joint="{joint}" kp="30" kv="2" ctrlrange="-.3 .2"/>', "position", -0.3, 0.2),
        ('<position joint="{joint}" kp="30" kv="2" gear="-2" ctrlrange="-.3 .2"/>', "position", -0.1, 0.15),
        ('<velocity joint="{joint}" kv="3" ctrlrange="-7 5"/>', "velocity", -7.0, 5.0),
    ],
)
def test_targets_stay_within_the_range_of_the_actuators_command(write, actuator, control, low, high):
    settings = derive(write(mjcf(actuator)))
    drive = settings.drives["fl_hip"]
    assert (drive.control, drive.target_low, drive.target_high) == (control, low, high)
    assert files.read(write(files.written(settings), "again.toml")) == settings
    robot = robot_of(settings)
    for action, target in ((9.0, high), (-9.0, low), (0.1, 0.1 * drive.scale)):
        assert np.asarray(robot.command(jnp.full(8, action)))[0] == pytest.approx(target)
    assert all(each.ok for each in RobotTrial(robot).moved())
    free = replace(
        settings, drives={n: replace(d, target_low=0.0, target_high=0.0) for n, d in settings.drives.items()}
    )
    assert "target" not in free.identity
    assert np.asarray(robot_of(free).command(jnp.full(8, 9.0)))[0] == pytest.approx(9 * drive.scale)
    assert settings.identity != free.identity


def test_settings_of_contacts_and_of_the_base_that_are_left_out_are_told(write):
    text = mjcf(POSITION, free='<joint type="free" damping="1"/>')
    text = text.replace('size=".03"', 'size=".03" margin=".01"').replace('size=".02"', 'size=".02" solmix="3"')
    told = [
        "the margin of 4 geoms, which touch at a distance of 0 here",
        "solmix of 4 geoms, all of which weigh alike here",
    ]
    told += ["damping, armature, friction and springs of the base, which moves freely"]
    assert source_of(derive(write(text))).left_out[3:] == told
