import dataclasses
import math
from operator import attrgetter

import pytest

from league.config import experiment as config
from league.config import presets
from league.config.schema import ConfigError
from league.config.sections import Budget, PlayerSettings, named_players
from league.config.stages import Stage


@pytest.mark.parametrize("name", presets.PRESETS)
def test_a_preset_survives_its_own_file(name):
    preset = presets.preset(name)
    assert config.loads(config.dumps(preset)) == preset
    short = config.dumps(preset, comments=False)
    assert config.loads(short) == preset
    assert "#" not in short
    assert len(short) < len(config.dumps(preset)) / 4


HARL_A = """
training.worlds 5000
training.rollout_length 200
training.schedule.kind leapfrog
training.schedule.period_steps 50000000
training.schedule.learner 0
training.opponents.kind latest
training.resting_critics True
training.shaping_steps 0
learner.method happo
learner.architecture.hidden (128, 128)
learner.architecture.activation relu
learner.architecture.layer_norm True
learner.architecture.squash None
learner.architecture.state_std False
learner.critic_input own
learner.share_actors False
learner.lr 0.0005
learner.critic_lr 0.0005
learner.lr_decay_steps 0
learner.desired_kl None
learner.target_kl None
learner.epochs 5
learner.minibatches 1
learner.clip 0.2
learner.entropy_coef 0.01
learner.max_grad_norm 10.0
learner.gamma 0.99
learner.gae_lambda 0.95
learner.value_norm True
learner.huber_delta 10.0
learner.normalise_observations False
learner.fixed_order True
seed 1
arena.rules.decide_every 1
arena.rules.episode 30.0
arena.rules.ring (3.0, 6.0)
arena.rules.drive_limit None
arena.reward.scale 10.0
arena.reward.timeout_penalty 1.0
budget.steps 10000000000
"""


def test_harl_a_has_the_papers_table_of_settings():
    preset = presets.preset("harl_a")
    found = [f"{line.split()[0]} {attrgetter(line.split()[0])(preset)}" for line in HARL_A.split("\n") if line]
    assert found == HARL_A.strip().split("\n")
    assert preset.learner.initial_std == pytest.approx(0.5 / (1 + math.exp(-1)), abs=1e-5)  # std_y 0.5, std_x 1
    assert preset.league == "harl_a"


def test_every_setting_is_explained():
    text = config.dumps(presets.preset("quickstart"))
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
        ("[training.schedule]\nperiod_steps = 0\n", "period_steps is 0; a phase lasts 1 environment step or more"),
        ("[arena.rules]\ntimestep = 0.013\n", "no whole number"),
        ("[rating]\nshare = 10\n", "league.toml:2: rating.share = 10.0: must be between 0.0 and 1.0"),
        ("[rating]\nshare = 0.0\n[budget]\nsuccess = 0.9\n", "rating.share = 0.0: must be above 0 where"),
        ("[rating]\nworlds = 100\npairings = 4\n", "rating.worlds = 100: must be a multiple of 2 × rating.pairings, 8"),
        ("[rating]\nworlds = 101\n", "rating.worlds = 101: must be a multiple of 2; every pairing"),
        ("[rating]\npairings = 0\n", "rating.pairings = 0: must be"),
        ('[rating]\nmilestones = ["soon"]\n', '"soon" is not a duration'),
        ("[learner\n", "league.toml:1: not TOML"),
        ("deterministic = true\n", "league.toml:1: deterministic = true: needs a budget in steps"),
        (
            'deterministic = true\n[budget]\nsteps = 9\ntraining_time = "1m"\n',
            'league.toml:4: budget.training_time = "1m": time runs',
        ),
        ("[training]\nworlds = 4\n[training.opponents]\nkind = 'uniform'\npast = 0.5\n", "only 4 worlds to share"),
        ('deterministic = true\n[training.opponents]\nkind = "nash"\n', "no fixed order"),
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


def test_an_unknown_preset_names_the_nearest_alone_and_all_only_without_one():
    with pytest.raises(ConfigError) as near:
        presets.preset("quikstart")
    assert str(near.value).endswith("'quikstart': did you mean quickstart? (`league presets` lists all)")
    with pytest.raises(ConfigError) as far:
        presets.preset("nonsense")
    assert all(name in str(far.value) for name in presets.PRESETS)


def test_a_rule_that_is_taken_away_from_an_arena_stays_away():
    by_team = config.default("sumo-by-team")
    assert by_team.arena.rules.wheel_limit is not None
    rules = dataclasses.replace(by_team.arena.rules, wheel_limit=None)
    changed = dataclasses.replace(by_team, arena=dataclasses.replace(by_team.arena, rules=rules))
    assert config.loads(config.dumps(changed)) == changed


def test_steps_and_time_of_the_whole_league_bound_every_stage():
    stages = (Stage("short", {"budget": {"training_time": "5m", "steps": 10}}), Stage("last", {}))
    for own, other in ((stages, "20m"), (stages, None)):
        league = dataclasses.replace(presets.preset("walk"), stages=own, budget=Budget(training_time=other, steps=100))
        short, last = (config.stage(league, number).budget for number in (0, 1))
        assert (short.training_time, short.steps) == ("5m", 10)
        assert (last.training_time, last.steps) == (other, 100)
    bounded = dataclasses.replace(league, budget=Budget(training_time="30s", steps=4))
    assert {(b.training_time, b.steps) for b in (config.stage(bounded, n).budget for n in (0, 1))} == {("30s", 4)}


@pytest.mark.parametrize("name", ["gate-race", "gate-race-4"])
def test_a_drone_alone_has_no_bound_of_time_but_one_that_is_given(name):
    league = presets.preset(name)
    assert [config.stage(league, number).budget.training_time for number in (0, 1)] == [None, "20m"]
    given = dataclasses.replace(league, budget=dataclasses.replace(league.budget, training_time="1m"))
    assert [config.stage(given, number).budget.training_time for number in (0, 1)] == ["1m", "1m"]
