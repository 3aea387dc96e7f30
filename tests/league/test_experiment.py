import dataclasses

import pytest

from league.config import experiment as config
from league.config import presets
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings, named_players


@pytest.mark.parametrize("name", presets.PRESETS)
def test_a_preset_survives_its_own_file(name):
    preset = presets.preset(name)
    assert config.loads(config.dumps(preset)) == preset


def test_every_setting_is_explained():
    text = config.dumps(presets.quickstart())
    lines = text.splitlines()
    for i, line in enumerate(lines):
        if " = " in line and not line.startswith("#"):
            assert lines[i - 1].startswith("#"), f"no comment above {line!r}"


def test_what_a_file_leaves_out_is_as_the_named_arena_has_it():
    loaded = config.loads('[arena]\nname = "sumo-1v1"\n[learner]\nlr = 0.002\n')
    assert loaded.arena.blue == ("leatherback",)
    assert loaded.arena.rules.ring == (1.2, 1.8)
    assert loaded.learner == dataclasses.replace(config.default().learner, lr=0.002)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[learner]\ngamma = 1.5\n", "league.toml:2: learner.gamma = 1.5: must be between 0"),
        ('[learner]\n\nlr = "fast"\n', 'league.toml:3: learner.lr = "fast"'),
        ("[arena.rules]\nradiuss = 2\n", "league.toml:2: unknown key arena.rules.radiuss"),
        ('[training.schedule]\nkind = "leapfrogg"\n', "leapfrog"),
        ("[training.schedule]\nperiod_steps = 0\n", "period_steps is 0; a turn lasts 1 environment step or more"),
        ("[arena.rules]\ntimestep = 0.013\n", "no whole number"),
        ("[rating]\nworlds = 100\n", "must be a multiple of 2 × rating.pairings, 8"),
        ('[rating]\nmilestones = ["soon"]\n', '"soon" is not a duration'),
        ("[learner\n", "league.toml:1: not TOML"),
        ("deterministic = true\n", "league.toml:1: deterministic = true: needs a budget in steps"),
        ('deterministic = true\n[budget]\nsteps = 9\ntrain = "1m"\n', 'league.toml:4: budget.train = "1m": time runs'),
        ("[training]\nworlds = 4\n[training.opponents]\nkind = 'uniform'\npast = 0.5\n", "only 4 worlds to share"),
        ('deterministic = true\n[training.opponents]\nkind = "prioritized"\npast = 0.5\n', "no fixed order"),
    ],
)
def test_a_wrong_setting_is_one_line_with_place_and_possibilities(text, says):
    with pytest.raises(ConfigError) as caught:
        config.loads(text)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


PLAYERS = """
[[players]]
team = "blue"

[[players]]
team = "blue"
hidden = [32, 32]
lr = 0.01

[[players]]
team = "red"
group = "2"
"""


def test_players_stand_in_a_file_and_have_names_and_groups_of_their_own():
    loaded = config.loads(PLAYERS)
    assert config.loads(config.dumps(loaded)) == loaded
    assert loaded.players[1].hidden == (32, 32)
    assert loaded.players[0] == PlayerSettings("blue")
    assert [(p.name, p.group) for p in named_players(loaded.players)] == [("blue", "1"), ("blue-2", "2"), ("red", "2")]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('name = "blue-2"', "players: 2 are called blue-2; give each a name of its own"),
        ('group = "2"', "players: group 2 has 2 of team blue; one of each team learns together"),
        ('name = "a@b"', 'players[3].name = "a@b": a name is made of letters'),
        ("hidden = [0]", "players[3].hidden = [0]: must be between 1 and 8192"),
        ("hidden = []", "players[3].hidden = []: must be at least one width"),
        ("learns = true", "league.toml:15: unknown key players[3].learns"),
    ],
)
def test_players_that_contradict_each_other_are_refused(text, says):
    with pytest.raises(ConfigError) as caught:
        config.loads(f'{PLAYERS}[[players]]\nteam = "blue"\n{text}\n')
    assert says in str(caught.value)


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean quickstart"):
        presets.preset("quikstart")


def test_a_rule_that_is_taken_away_from_an_arena_stays_away():
    by_team = config.default("sumo-by-team")
    assert by_team.arena.rules.wheel_limit is not None
    rules = dataclasses.replace(by_team.arena.rules, wheel_limit=None)
    changed = dataclasses.replace(by_team, arena=dataclasses.replace(by_team.arena, rules=rules))
    assert config.loads(config.dumps(changed)) == changed
