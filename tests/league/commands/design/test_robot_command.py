"""`league robot`: reads a model, tries and draws it, and writes a robot file that arenas take."""

import shlex

import pytest

from arenas.robots.files import robot_file as files
from league.commands import cli
from tests.arenas.robots.bot import mjcf

MOTOR = '<motor joint="{joint}" ctrlrange="-15 15"/>'


@pytest.fixture
def model(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bot.xml").write_text(mjcf(MOTOR))
    return tmp_path / "bot.xml"


def ran(capsys, *args):
    with pytest.raises(SystemExit) as end:
        cli.main(["robot", *map(str, args)])
    out, err = capsys.readouterr()
    return end.value.code, out, err


@pytest.mark.slow
def test_a_model_is_tried_drawn_and_written(capsys, model, tmp_path):
    picture = tmp_path / "bot.png"
    code, out, _ = ran(capsys, "bot.xml", "--control", "position", "--shot", picture)
    assert code == 0
    assert "left out: 1 geom of the scene, 1 light, 1 camera" in out
    assert "FAILED" not in out
    assert "fl_knee" in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    settings = files.read(tmp_path / "bot.toml")
    assert {drive.control for drive in settings.drives.values()} == {"position"}
    assert {drive.effort for drive in settings.drives.values()} == {15.0}
    code, out, _ = ran(capsys, "bot.toml")
    assert code == 0
    assert "Wrote" not in out
    assert "Play it: league check walk --arena.blue bot.toml" in out
    assert "Mend" not in out
    assert "drives and pose of bot.toml, not of the model" not in out
    code, out, _ = ran(capsys, "bot.xml")
    assert code == 0
    assert "drives and pose of bot.toml, not of the model" in out


def test_a_picture_of_no_kind_is_refused_before_the_robot_is_tried(capsys, model, tmp_path):
    code, out, err = ran(capsys, "bot.xml", "--shot", tmp_path / "bot.txt")
    assert (code, out) == (2, "")
    assert "a picture is a file named *.png, *.jpg, *.jpeg, *.webp, not bot.txt" in err
    assert not (tmp_path / "bot.toml").exists()


def test_a_robot_that_falls_is_written_and_said(capsys, model, tmp_path):
    code, out, _ = ran(capsys, "bot.xml", "--passive", "fl_hip,fl_knee,hl_hip,hl_knee", "-o", "limp.toml")
    assert code == 1
    assert "FAILED  stands" in out
    assert "Play it" not in out
    mended = out[out.index("Mend it first:") :]
    assert "bend `home`" in mended
    assert mended.endswith("then try it again with: league robot limp.toml\n")
    assert files.read(tmp_path / "limp.toml").passive == ("fl_hip", "fl_knee", "hl_hip", "hl_knee")


BLOCK = """<mujoco><worldbody><body name="block" pos="0 0 .05"><freejoint/><geom type="box" size=".2 .2 .05" mass="3"/>
<body name="arm" pos="0 0 .05"><joint name="turn" axis="0 0 1"/>
<geom type="capsule" fromto="0 0 .05 .2 0 .05" size=".02" mass=".3"/></body></body></worldbody>
<actuator><motor joint="turn"/></actuator></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("half", ["0.2", "0.7"])  # the larger does not fit sumo's usual ring
def test_a_robot_that_rests_on_its_base_is_not_told_to_walk(capsys, model, tmp_path, half):
    (tmp_path / "my block.xml").write_text(BLOCK.replace('size=".2 .2 ', f'size="{half} .2 '))
    code, out, _ = ran(capsys, "my block.xml")
    assert code == 0
    assert "league robot 'my block.toml'" in out
    assert "Its base touches the ground after" in out
    commands = [line.split("league ", 1)[1] for line in out.splitlines() if "--arena.blue" in line]
    assert [command.split()[:2] for command in commands] == [["check", "sumo-1v1"], ["run", "--arena.name"]]
    given = shlex.split(commands[0])
    assert given[given.index("--arena.blue") + 1] == "my block.toml"
    with pytest.raises(SystemExit) as end:
        cli.main([*given, "--engine", "c"])
    assert end.value.code == 0


UNSTEADY = """<mujoco model="tricart"><worldbody><body name="chassis" pos="0 0 0.12"><freejoint/>
<geom type="box" size="0.25 0.15 0.05" mass="8"/><geom type="box" pos="0.27 0 -0.03" size="0.02 0.18 0.05" mass="0.5"/>
<body name="left_wheel" pos="0.1 0.2 -0.02"><joint name="left" axis="0 1 0" damping="0.01"/>
<geom type="cylinder" size="0.1 0.03" euler="90 0 0" mass="0.6" friction="1 .005 .0001"/></body>
<body name="right_wheel" pos="0.1 -0.2 -0.02"><joint name="right" axis="0 1 0" damping="0.01"/>
<geom type="cylinder" size="0.1 0.03" euler="90 0 0" mass="0.6" friction="1 .005 .0001"/></body>
<body name="rear" pos="-0.22 0 -0.05"><joint name="caster" axis="0 1 0" damping="0.005"/>
<geom type="sphere" size="0.07" mass="0.3" friction="0.05"/></body></body></worldbody><actuator>
<velocity joint="left" kv="3" ctrlrange="-15 15" forcerange="-10 10"/>
<velocity joint="right" kv="3" ctrlrange="-15 15" forcerange="-10 10"/></actuator></mujoco>"""


@pytest.mark.slow
def test_rare_instability_is_found_and_the_setting_that_is_named_mends_it(capsys, model, tmp_path):
    (tmp_path / "cart.xml").write_text(UNSTEADY)
    code, out, _ = ran(capsys, "cart.xml", "--passive", "caster")
    assert code == 1
    assert "FAILED  flails without breaking: unstable in" in out
    assert "with ls_iterations = 10 in the robot file, in none" in out
    assert "Play it" not in out
    written = (tmp_path / "cart.toml").read_text()
    assert "ls_iterations = 4 " in written
    (tmp_path / "cart.toml").write_text(written.replace("ls_iterations = 4", "ls_iterations = 10"))
    code, out, _ = ran(capsys, "cart.toml")
    assert code == 0
    assert "Play it: league check walk --arena.blue cart.toml" in out  # its base stays off the ground


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("gone.xml",), "no file gone.xml"),
        (("bot",), "bot: give an MJCF (.xml) or URDF (.urdf) file"),
        (("bot.xml", "--passive", "tail"), "no joint tail for --passive"),
        (("nan.xml",), 'nan.xml: geom of base has mass="nan": give numbers, or leave mass out'),
        (("bot.xml", "-o", "bot.yaml"), "a robot file is named *.toml"),
        (("bot.xml", "-o", "there/bot.toml"), "there is no folder there"),
        (("bot.xml", "-o", "kept.toml"), "kept.toml is there already"),
        (("bot.xml", "--fit"), "--fit is for a robot file"),
        (("ant", "--control", "torque"), "it is a robot file: edit it"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(capsys, model, tmp_path, args, said):
    (tmp_path / "kept.toml").write_text("kept")
    (tmp_path / "nan.xml").write_text(mjcf(MOTOR).replace('mass="5"', 'mass="nan"'))
    code, _, err = ran(capsys, *args)
    assert code == 2
    assert said in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bot.xml", "kept.toml", "nan.xml"]
    assert (tmp_path / "kept.toml").read_text() == "kept"


def test_check_takes_the_robot(capsys, model):
    with pytest.raises(SystemExit) as end:
        cli.main(["check", "walk", "--arena.blue", "gone.xml"])
    assert end.value.code == 2
    assert "--arena.blue" in capsys.readouterr().err
