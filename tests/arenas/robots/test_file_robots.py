"""Robots from files: what is read, built and refused, and that arenas know their content."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import arenas
from arenas.arena_settings import Solver
from arenas.contract.robot_trial import RobotTrial
from arenas.errors import ArenaError
from arenas.robots.files import robot_file as files
from arenas.robots.files.catalogue import robot_file
from arenas.robots.files.defaults import derive, fitted
from arenas.robots.files.extents import lowest
from arenas.robots.files.loading import file_robot, robot_of, source_of
from arenas.robots.kinds import kind_of
from arenas.robots.kinematics import HeightReader
from arenas.scene.scene import build
from tests.arenas.robots.bot import LEGS, cart, mjcf, urdf

POSITION = '<position joint="{joint}" kp="30" kv="2"/>'
MOTOR = '<motor joint="{joint}" gear="4" ctrlrange="-3 3"/>'


def test_a_model_becomes_one_body_that_touches_ground_and_bodies_and_leaves_its_scene_behind(write):
    skin = '<deformable><flex name="skin" dim="1" body="base" vertex="0 0 0 0 0 .1" element="0 1"/></deformable>'
    path = write(mjcf(POSITION, extra=skin))
    source = source_of(derive(path))
    assert source.left_out == ["1 geom of the scene", "1 light", "1 camera", "1 flex part"]
    scene = build({"blue": [file_robot(str(path))] * 2}, timestep=0.005)
    model = scene.model
    assert (model.ncam, model.nlight) == (0, 1)  # the light of our own scene
    assert model.body_mass.sum() == pytest.approx(2 * 7.8)
    assert sum(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) == 1
    robots = model.geom_bodyid > 0
    assert set(model.geom_contype[robots]) == {2}
    assert set(model.geom_conaffinity[robots]) == {3}


@pytest.mark.parametrize(
    ("actuators", "control", "numbers"),
    [
        (POSITION, "position", {"kp": 30.0, "kd": 2.0, "effort": 20.0}),
        ('<velocity joint="{joint}" kv="3" ctrlrange="-7 7"/>', "velocity", {"kd": 3.0, "scale": 7.0}),
        (MOTOR, "torque", {"scale": 12.0, "effort": 12.0}),
        ('<position joint="{joint}" kp="30"/><velocity joint="{joint}" kv="4"/>', "position", {"kp": 30.0, "kd": 4.0}),
        ('<position joint="{joint}" kp="5" gear="2"/>', "position", {"kp": 20.0}),
        (MOTOR.replace('"4"', '"-4"'), "torque", {"scale": -12.0, "effort": 12.0}),
        ('<velocity joint="{joint}" kv="3" gear="-2" ctrlrange="-7 7"/>', "velocity", {"kd": 12.0, "scale": -3.5}),
        ('<position joint="{joint}" kp="5" forcerange="-9 2"/>', "position", {"effort": 9.0}),
    ],
)
def test_actuators_of_each_kind_are_read(write, actuators, control, numbers):
    drive = derive(write(mjcf(actuators))).drives["fl_knee"]
    assert drive.control == control
    assert {name: getattr(drive, name) for name in numbers} == pytest.approx(numbers)


@pytest.mark.parametrize("control", ["position", "velocity", "torque"])
def test_a_joint_follows_its_command_under_every_control(write, control):
    settings = derive(write(mjcf(MOTOR)), control=control)
    assert {drive.control for drive in settings.drives.values()} == {control}
    moved = RobotTrial(robot_of(settings)).moved()
    assert [each.joint for each in moved] == list(settings.drives)
    assert all(each.ok and each.by > 0.01 for each in moved)


def test_a_model_without_actuators_stands_by_pd_targets(write):
    settings = derive(write(mjcf()))
    assert settings.feet == tuple(f"{leg}_shank" for leg in LEGS)
    assert settings.height == pytest.approx(0.43)
    assert [f for f in RobotTrial(robot_of(settings)).findings() if not f.ok] == []


def test_a_urdf_gets_a_free_base_and_its_efforts(write):
    settings = derive(write(urdf(), "bot.urdf"))
    assert settings.drives["hr_knee"].effort == 20.0
    assert settings.height == pytest.approx(0.43)
    assert [f for f in RobotTrial(robot_of(settings)).findings() if not f.ok] == []


def test_a_sliding_joint_without_gains_holds_its_load(write):
    lift = """</body><body name="lift"><joint name="lift" type="slide" axis="0 0 1" range="0 .4"/>
<geom type="sphere" size=".05" pos="0 0 .2" mass="1"/></body></body>"""
    text = mjcf().replace("</body>\n</worldbody>", lift.removeprefix("</body>") + "\n</worldbody>")
    settings = derive(write(text))
    assert settings.drives["lift"].kp > 1 * 9.81 / 0.02  # N/m: the load of 1 kg lowers it by less than 2 cm
    assert [f for f in RobotTrial(robot_of(settings)).findings() if not f.ok] == []
    by_speed = derive(write(text), control="velocity")
    assert (by_speed.drives["lift"].scale, by_speed.drives["fl_hip"].scale) == (0.5, 10.0)


def test_the_standing_pose_is_the_keyframe(write):
    key = f'<keyframe><key name="home" qpos="0 0 .4 1 0 0 0 {"0.5 -1 " * 4}"/></keyframe>'
    settings = derive(write(mjcf(POSITION, extra=key)))
    assert (settings.drives["fl_hip"].home, settings.drives["fl_knee"].home) == (0.5, -1.0)
    assert settings.height == pytest.approx(2 * 0.2 * np.cos(0.5) + 0.03, abs=1e-3)


def test_the_keyframe_is_that_of_the_joints_where_the_base_is_freed(write):
    key = f'<keyframe><key name="home" qpos="{"0.5 -1 " * 4}"/></keyframe>'
    settings = derive(write(mjcf(POSITION, free="", extra=key)), free_base=True)
    assert [drive.home for drive in settings.drives.values()] == [0.5, -1.0] * 4


def test_a_turned_gear_turns_what_an_action_does_and_wheels_still_drive_ahead(write):
    turned = derive(write(mjcf(MOTOR.replace('"4"', '"-4"'))))
    moved = RobotTrial(robot_of(turned)).moved()
    assert all(each.ok and each.by < -0.01 for each in moved)
    text = cart().replace('joint="right"', 'joint="right" gear="-1"')
    drive = file_robot(str(write(text, "cart.xml"))).drive
    assert drive is not None
    ahead = np.asarray(drive(jnp.array([2.0, 0.0]), False))
    assert ahead[0] == ahead[1] > 0  # the right axle points backwards, and its gear turns that around


@pytest.mark.parametrize("actuator", ['<motor joint="{joint}"/>', '<velocity joint="{joint}" kv="3"/>'])
def test_a_turned_gear_turns_what_an_action_does_without_a_control_range_too(write, actuator):
    as_it_is = derive(write(mjcf(actuator))).drives["fl_knee"].scale
    turned = derive(write(mjcf(actuator.replace("/>", ' gear="-1"/>')))).drives["fl_knee"].scale
    assert turned == -as_it_is < 0


def test_a_tilted_base_is_turned_upright(write):
    text = mjcf(POSITION).replace('pos="0 0 .6">', 'pos="0 0 .6" quat=".5 .5 .5 .5">')
    turned = text.replace("<freejoint/>", '<freejoint/><frame quat=".5 -.5 -.5 -.5">').replace(
        "</body>\n</worldbody>", "</frame></body>\n</worldbody>"
    )
    settings = derive(write(turned))
    assert settings.height == pytest.approx(0.43)
    assert [f for f in RobotTrial(robot_of(settings)).findings() if not f.ok] == []


def test_a_robot_file_is_read_back_and_an_edited_pose_is_fitted(write):
    path = write(mjcf(POSITION))
    settings = derive(path)
    toml = write(files.written(settings), "edited.toml")
    assert files.read(toml) == settings
    bent = {
        name: replace(drive, home=-1.0 if name.endswith("knee") else 0.5) for name, drive in settings.drives.items()
    }
    toml.write_text(files.written(replace(settings, drives=bent)))
    wrong = files.read(toml)
    placed = {finding.name: finding for finding in RobotTrial(robot_of(wrong)).findings()}["placed on the ground"]
    assert not placed.ok
    assert "--fit" in placed.detail
    assert fitted(source_of(wrong), wrong).height == pytest.approx(2 * 0.2 * np.cos(0.5) + 0.03, abs=1e-3)


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("fl_hip = {", "fl_hipp = {",
         r"\[joints\]: .*bot\.xml has no joint 'fl_hipp': did you mean fl_hip.*possible: .*hr_knee"),
        ('base = "base"', 'base = "bas"',
         r"base: .*bot\.xml has no body 'bas': did you mean base\? \(possible: base\)$"),
        ("passive = []", 'passive = ["tail"]', r"passive: .*bot\.xml has no joint 'tail': \(possible: fl_hip, "),
        ("feet = [", 'feet = ["paw", ', r"feet: .*bot\.xml has no body 'paw': "),
    ],
)  # fmt: skip
def test_a_name_that_the_model_lacks_is_told_with_the_robot_file_and_the_key(write, right, wrong, said):
    model = write(mjcf(POSITION))
    toml = model.with_suffix(".toml")
    text = files.written(derive(model)).replace('"fl_hip" = {', "fl_hip = {")
    assert text.count(right) == 1
    toml.write_text(text.replace(right, wrong))
    with pytest.raises(ArenaError, match=rf"^{re.escape(str(toml))}: {said}"):
        source_of(files.read(toml))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (mjcf(free=""), "no body has a free joint: body base is fixed to the world; add <freejoint/> to it"),
        (mjcf(POSITION, knees=("fl", "fr", "hl")), "joint hr_knee has no actuator"),
        (mjcf(POSITION, knees=("fl", "fr")), "hl_knee, hr_knee have no actuator.*bot.xml --passive hl_knee,hr_knee$"),
        (mjcf(MOTOR + MOTOR), r"joint fl_hip has two actuators \(torque and torque\).*keep one"),
        (mjcf('<muscle joint="{joint}"/>'), "actuator 0 of joint fl_hip is no motor, position or"),
        (mjcf().replace('name="fl_hip" axis="0 1 0" range="-1 1"', 'name="fl_hip" type="ball" range="0 1"'), "fl_hip"),
        (mjcf().replace('type="box" size=".2 .1 .05" mass="5"', 'type="mesh" mesh="m"').replace(
            "<worldbody>", '<asset><mesh name="m" file="gone.stl"/></asset><worldbody>'), "body base .*gone.stl"),
        (mjcf(extra='<equality><joint name="tie" joint1="fl_hip" joint2="fr_hip"/></equality>'), "equality tie"),
        (mjcf('<general joint="{joint}" gainprm="9" biastype="affine" biasprm="5 -9 -1"/>'), "fl_hip is no motor"),
        (mjcf(POSITION).replace('pos="0 0 .6">', 'pos="0 0 .6"><frame pos="0 0 .43">').replace(
            "</body>\n</worldbody>", "</frame></body>\n</worldbody>").replace("<freejoint/>", "").replace(
            "<frame", "<freejoint/><frame"), "the origin of base base is not above the lowest of its geoms"),
        ("<mujoco><worldbody><body", "XML"),
    ],
)  # fmt: skip
def test_a_model_that_is_no_robot_is_refused_in_one_line_that_names_file_and_part(write, text, said):
    with pytest.raises(ArenaError, match=rf"bot\.xml: .*{said}") as refused:
        derive(write(text))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("kp = 30.0", "kp = -1.0", "joint fl_hip: kp, kd, effort and armature must be at least 0"),
        ("kp = 30.0", 'kp = "soft"', "joint fl_hip: kp = 'soft': expected a number"),
        ('base = "base"', "", "base is missing"),
        ("width", "breadth", "unknown setting breadth"),
        ('"fl_hip" =', '"fl_hop" =', "fl_hop"),
        ("low = -1.0", "low = 3.0", "low = 3 is above high = 1"),
    ],
)
def test_a_bad_robot_file_is_refused_in_one_line(write, old, new, said):
    text = files.written(derive(write(mjcf(POSITION))))
    assert old in text
    bad = write(text.replace(old, new, 1), "bad.toml")
    with pytest.raises(ArenaError, match=said) as refused:
        file_robot(str(bad))
    assert "\n" not in str(refused.value)


def test_the_configuration_hash_follows_model_gains_scales_and_pose(write):
    model = write(mjcf(POSITION))
    toml = write(files.written(derive(model)), "mine.toml")
    rules = replace(arenas.settings("sumo-1v1").rules, ring=(3.0, 3.0))

    def hashed():
        settings = replace(arenas.settings("sumo-1v1"), blue=(str(toml),), red=("leatherback",), rules=rules)
        return settings.build(engine="c").config_hash

    text, found = toml.read_text(), [hashed()]
    assert hashed() == found[0]
    for old, new in (("kp = 30.0", "kp = 31.0"), ("scale = 0.5", "scale = 0.6"), ("home = 0.0", "home = 0.1")):
        toml.write_text(text.replace(old, new, 1))
        found.append(hashed())
    toml.write_text(text)
    model.write_text(mjcf(POSITION).replace('mass=".5"', 'mass=".6"'))
    found.append(hashed())
    assert len(set(found)) == len(found)


def test_the_solver_of_a_scene_takes_the_line_search_steps_of_the_robot_that_needs_most(write):
    model = write(mjcf(POSITION))
    toml = write(files.written(replace(derive(model), ls_iterations=10)), "steady.toml")
    plain = replace(arenas.settings("walk"), blue=(str(model),)).build(engine="c")
    steady = replace(arenas.settings("walk"), blue=(str(toml),)).build(engine="c")
    assert (plain.scene.model.opt.ls_iterations, steady.scene.model.opt.ls_iterations) == (4, 10)
    assert plain.config_hash != steady.config_hash
    assert robot_file(str(model)).identity == robot_file(str(toml)).identity  # so hashes of before the setting hold
    teams = {"blue": [file_robot(str(model))], "red": [file_robot(str(toml))]}
    assert build(teams, timestep=0.005).model.opt.ls_iterations == 10
    assert build(teams, solver=Solver(ls_iterations=50), timestep=0.005).model.opt.ls_iterations == 50


def test_two_files_of_one_name_cannot_meet(write, tmp_path):
    write(mjcf(POSITION))
    (tmp_path / "other").mkdir()
    other = tmp_path / "other" / "bot.xml"
    other.write_text(mjcf(MOTOR))
    rules = replace(arenas.settings("sumo-1v1").rules, ring=(3.0, 3.0))
    both = replace(arenas.settings("sumo-1v1"), blue=(str(tmp_path / "bot.xml"),), red=(str(other),), rules=rules)
    with pytest.raises(ArenaError, match="two robot files are named bot"):
        both.build(engine="c")


@pytest.mark.parametrize("name", ["sumo-1v1", "soccer-1v1", "walk"])
def test_an_arena_takes_a_model_where_a_kind_is_named(write, name):
    path = str(write(mjcf(POSITION)))
    settings = replace(arenas.settings(name), blue=(path,))
    if name == "sumo-1v1":
        settings = replace(settings, rules=replace(settings.rules, ring=(3.0, 3.0)))
    arena = settings.build(engine="c")
    seat = settings.outline().teams["blue"][0]
    spec = arena.teams[0].agents[0]
    assert (spec.kind, spec.observation_size, spec.action_size) == seat == ("bot", seat.observation_size, 8)
    assert sum(part.size for part in arena.observation_parts("blue/0")) == spec.observation_size
    assert {"idle", "random"} <= set(arena.playable_scripts(arena.teams[0]))
    state = jax.jit(arena.reset)(jax.random.key(0))
    own = kind_of(path).proprioception_size
    sensed = np.asarray(state.observations["blue/0"][:own])
    np.testing.assert_allclose(sensed[6:9], [0, 0, -1], atol=1e-6)  # the down direction of a robot that stands
    np.testing.assert_allclose(sensed[9:], 0, atol=1e-6)  # joints at home and at rest, no action yet


def test_a_robot_on_wheels_is_driven_by_the_scripts_of_the_games(write):
    path = str(write(cart(), "cart.xml"))
    drive = file_robot(path).drive
    assert drive is not None
    ahead, left = (np.asarray(drive(jnp.array(at), False)) * [1, -1] for at in ([2.0, 0.0], [0.0, 2.0]))
    assert ahead[0] == ahead[1] > 0  # the right axle points backwards
    assert left[1] > 0 > left[0]
    np.testing.assert_allclose(drive(jnp.zeros(2), True), 0)
    duel = replace(arenas.settings("sumo-1v1"), blue=(path,)).build(engine="c")
    match = replace(arenas.settings("soccer-1v1"), blue=(path,)).build(engine="c")
    assert "pusher" in duel.playable_scripts(duel.teams[0])
    assert {"striker", "keeper", "chaser"} <= set(match.playable_scripts(match.teams[0]))
    strike, key = jax.jit(match.scripts()["striker"]["cart"]), jax.random.key(0)
    state = jax.jit(match.reset)(key)
    assert np.abs(strike(state.observations["blue/0"], key)).max() > 0.1
    assert file_robot(str(write(mjcf(POSITION)))).drive is None


def test_heights_are_those_of_mujocos_own_geometry(write):
    robot = file_robot(str(write(mjcf(POSITION))))
    scene = build({"blue": [robot]}, timestep=0.005)
    model, at = scene.model, scene.agents["blue/0"]
    reader = HeightReader(model, at.base, [f"blue/0/{foot}" for foot in robot.feet])
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    data.qpos[:] = scene.rest + 0.3 * rng.normal(size=model.nq)
    data.qpos[at.qpos + 3 : at.qpos + 7] /= np.linalg.norm(data.qpos[at.qpos + 3 : at.qpos + 7])
    mujoco.mj_kinematics(model, data)
    low = reader.read(jnp.asarray(data.qpos, jnp.float32))
    geoms = {model.body(model.geom_bodyid[g]).name: lowest(data, g) for g in range(1, model.ngeom)}
    assert float(low.torso) == pytest.approx(geoms["blue/0/base"], abs=1e-5)
    np.testing.assert_allclose(low.feet, [geoms[f"blue/0/{leg}_shank"] for leg in LEGS], atol=1e-5)
    np.testing.assert_allclose(low.limbs, [geoms[f"blue/0/{leg}_thigh"] for leg in LEGS], atol=1e-5)


def test_a_robot_file_beside_a_model_counts(write):
    path = write(mjcf(POSITION))
    write(files.written(replace(derive(path), name="rex")), "bot.toml")
    assert robot_file(str(path)).name == "rex"


def test_roster_errors_name_the_setting(write):
    settings = arenas.settings("sumo-1v1")
    with pytest.raises(ValueError, match=r"blue: unknown robot 'goo1': did you mean go1"):
        replace(settings, blue=("goo1",))
    with pytest.raises(ValueError, match=r"blue: no file my/gone\.xml"):
        replace(settings, blue=("my/gone.xml",))
    with pytest.raises(ValueError, match=r'observation: slots .* needs "rich"'):
        replace(arenas.settings("sumo-1v1-anymal"), blue=(str(write(mjcf())),))
