"""`league robot`: reads a model, tries and draws it, and writes a robot file that arenas take."""

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
    assert "drives and pose of bot.toml, not of the model" not in out
    code, out, _ = ran(capsys, "bot.xml")
    assert code == 0
    assert "drives and pose of bot.toml, not of the model" in out


def test_a_robot_that_falls_is_written_and_said(capsys, model, tmp_path):
    code, out, _ = ran(capsys, "bot.xml", "--passive", "fl_hip,fl_knee,hl_hip,hl_knee", "-o", "limp.toml")
    assert code == 1
    assert "FAILED  stands" in out
    assert files.read(tmp_path / "limp.toml").passive == ("fl_hip", "fl_knee", "hl_hip", "hl_knee")


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("gone.xml",), "no file gone.xml"),
        (("bot",), "bot: give an MJCF (.xml) or URDF (.urdf) file"),
        (("bot.xml", "--passive", "tail"), "no joint tail for --passive"),
        (("bot.xml", "-o", "bot.yaml"), "a robot file is named *.toml"),
        (("bot.xml", "-o", "there/bot.toml"), "there is no folder there"),
        (("bot.xml", "-o", "kept.toml"), "kept.toml is there already"),
        (("bot.xml", "--fit"), "--fit is for a robot file"),
        (("ant", "--control", "torque"), "it is a robot file: edit it"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(capsys, model, tmp_path, args, said):
    (tmp_path / "kept.toml").write_text("kept")
    code, _, err = ran(capsys, *args)
    assert code == 2
    assert said in err
    assert err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bot.xml", "kept.toml"]
    assert (tmp_path / "kept.toml").read_text() == "kept"


def test_check_takes_the_robot(capsys, model):
    with pytest.raises(SystemExit) as end:
        cli.main(["check", "walk", "--arena.blue", "gone.xml"])
    assert end.value.code == 2
    assert "--arena.blue" in capsys.readouterr().err
