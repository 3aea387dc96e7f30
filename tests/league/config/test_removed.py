"""A learner that was removed: what names it is refused in one line, and what only mentions it is read."""

import re
from dataclasses import replace

import pytest

from agents.settings import REMOVED
from league.commands.run.request import read
from league.config import experiment as configuration
from league.config.experiment import default
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.runtime.validation import validate
from league.state.setting_changes import learner_changes

# As commit 7228567 wrote it into each league.toml and store, whatever the class.
SECTION = """
[learner.sac]
lr = 0.001
batch = 1024
[learner.sac.replay]
capacity = 200000
saved = false
"""
WHY = re.escape("the learner sac was removed, ") + ".* commit 7228567"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_its_settings_are_read_without_effect(folder, capsys):
    (folder / "old.toml").write_text(f'arena.name = "rock-paper-scissors"\n[learner]\nlr = 0.01\n{SECTION}')
    request = read(["old.toml"])
    plain = default("rock-paper-scissors")
    assert request.config == replace(plain, learner=replace(plain.learner, lr=0.01))
    assert "sac" not in configuration.dumps(request.config)
    assert capsys.readouterr() == ("", "")
    with pytest.raises(ConfigError, match=r"unknown key learner\.sca"):
        configuration.loads(SECTION.replace("sac", "sca"))


def test_its_settings_are_read_in_stages_and_among_changes_of_a_lineage():
    stages = "".join(f'[[stages]]\nname = "{name}"\nbudget.steps = 9\nlearner.sac.batch = 9\n' for name in "ab")
    assert configuration.stage(configuration.loads(stages), 0).learner == default().learner
    before, now = f"[learner]\nlr = 0.25\n{SECTION}", configuration.dumps(default())
    assert learner_changes(before, now) == ["learner.lr 0.25 -> 0.001"]


@pytest.mark.parametrize(
    ("args", "line"),
    [
        (["--learner.class", "sac"], r'--learner\.class = "sac": '),
        (["--learner.sac.batch", "8192"], r"--learner\.sac\.batch: "),
        (["--learner.gamma", "0.99", "--learner.class=sac", "--learner.sac.replay-ratio=8"], r"--learner\.sac\.rep"),
        (["--learner.class", "sac", "--learner.gamma", "0.99"], r'--learner\.class = "sac": '),
    ],
)
def test_its_flags_are_refused_in_one_line(args, line):
    with pytest.raises(ConfigError, match=f"^{line}.*{WHY}") as refused:
        read(["--preset", "walk", *args])
    assert "\n" not in str(refused.value)


def test_a_file_that_asks_for_it_is_refused_with_its_line(folder):
    (folder / "old.toml").write_text(f'deterministic = true\nbudget.steps = 9\n[learner]\nclass = "sac"\n{SECTION}')
    request = read(["old.toml"])
    with pytest.raises(ConfigError) as refused:
        validate(request.config)
    assert str(request.with_location(refused.value)) == f'old.toml:4: learner.class = "sac": {REMOVED["sac"]}'


def test_a_player_who_asks_for_it_is_refused():
    players = (PlayerSettings("blue"), PlayerSettings("red", class_="sac"))
    with pytest.raises(ConfigError, match=rf'^players\[1\]\.class = "sac": {WHY}'):
        validate(replace(default("rock-paper-scissors"), players=players))
