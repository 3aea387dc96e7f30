import dataclasses

import pytest

from league import config
from league.settings import ConfigError


@pytest.mark.parametrize("name", config.PRESETS)
def test_a_preset_survives_its_own_file(name):
    preset = config.preset(name)
    assert config.loads(config.dumps(preset)) == preset


def test_every_setting_is_explained():
    text = config.dumps(config.quickstart())
    lines = text.splitlines()
    for i, line in enumerate(lines):
        if " = " in line and not line.startswith("#"):
            assert lines[i - 1].startswith("#"), f"no comment above {line!r}"


def test_what_a_file_leaves_out_is_as_the_named_arena_has_it():
    loaded = config.loads('[arena]\nname = "sumo-1v1"\n[learner]\nlr = 0.002\n')
    assert loaded.arena.team_size == 1
    assert loaded.arena.rules.ring == (1.2, 1.8)
    assert loaded.learner == dataclasses.replace(config.default().learner, lr=0.002)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[learner]\ngamma = 1.5\n", "league.toml:2: learner.gamma = 1.5: must be between 0"),
        ('[learner]\n\nlr = "fast"\n', 'league.toml:3: learner.lr = "fast"'),
        ("[arena.rules]\nradiuss = 2\n", "league.toml:2: unknown key arena.rules.radiuss"),
        ('[training.schedule]\nkind = "leapfrogg"\n', "leapfrog"),
        ("[arena.rules]\ntimestep = 0.013\n", "no whole number"),
        ("[rating]\nworlds = 100\n", "multiple of 2 × pairings"),
        ('[rating]\nmilestones = ["soon"]\n', '"soon" is not a duration'),
        ("[learner\n", "league.toml:1: not TOML"),
        ('deterministic = true\n[training.opponents]\nkind = "prioritized"\npast = 0.5\n', "no fixed order"),
    ],
)
def test_a_wrong_setting_is_one_line_with_place_and_possibilities(text, says):
    with pytest.raises(ConfigError) as caught:
        config.loads(text)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_preset_names_the_nearest():
    with pytest.raises(ConfigError, match="did you mean quickstart"):
        config.preset("quikstart")
