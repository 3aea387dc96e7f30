"""The presets of published leagues in the quick start's arena: what they are, and that AlphaStar's runs."""

import json

import pytest

from league.commands.analyse.explain import explain
from league.commands.run.status import status
from league.config import experiment as configuration
from league.config import presets
from league.config.schema import ConfigError
from league.runtime.validation import _validate_groups, roster, validate
from storage.store import Store
from tests.league.conftest import call

NAMES = ("selfplay", "leapfrog", "alphastar", "psro", "openai-five", "delta-uniform")


@pytest.mark.parametrize("name", NAMES)
def test_each_is_the_quick_start_by_a_published_rule_and_one_line_of_a_file(name):
    config = presets.preset(name)
    quick = presets.preset("quickstart")
    assert config.league == name
    assert (config.arena, config.learner, config.budget) == (quick.arena, quick.learner, quick.budget)
    assert configuration.loads(f'preset = "{name}"\n') == config
    assert configuration.loads(f'preset = "{name}"\nseed = 7\ntraining.worlds = 96\n').training.worlds == 96
    _validate_groups(config, ["blue", "red"])
    rules = {"selfplay": "latest", "leapfrog": "latest", "psro": "nash"}
    assert config.training.opponents.kind == rules.get(name, name.replace("-", "_"))
    kind = "leapfrog" if name == "leapfrog" else "simultaneous"
    assert config.training.schedule.kind == kind
    assert (config.training.schedule.until_score is not None) == (name == "leapfrog")


def test_alphastars_has_exploiters_of_both_kinds_for_each_team():
    config = presets.preset("alphastar")
    players = roster(config, ["blue", "red"])
    assert [(p.team, p.role, p.group) for p in players] == [
        (team, role, group)
        for role, group in (
            ("main", "main"), ("main_exploiter", "main-exploiters"), ("league_exploiter", "league-exploiters"),
        )
        for team in ("blue", "red")
    ]  # fmt: skip
    main, hunter, league = (config.role(name) for name in ("main", "main_exploiter", "league_exploiter"))
    assert (main.can_reset, main.win_rate, main.opponents.kind, main.meets) == (False, None, "alphastar", None)
    assert (hunter.reset, hunter.win_rate, hunter.opponents.kind, hunter.meets) == (
        "initial",
        0.7,
        "exploit",
        ("main",),
    )
    assert (league.reset_chance, league.opponents.weighting, league.meets) == (0.25, "linear_capped", None)


@pytest.mark.parametrize(("name", "magnet"), [("kuhn-poker", (0.2, 20)), ("leduc-poker", (0.05, 0))])
def test_games_of_hidden_information_have_a_magnet_and_no_discount(name, magnet):
    config = presets.preset(name)
    validate(config)
    assert (config.learner.magnet_coef, config.learner.magnet_updates, config.learner.gamma) == (*magnet, 1.0)
    assert (config.arena.name, config.training.opponents.kind) == (name, "latest")
    assert configuration.loads(f'preset = "{name}"\n') == config


def test_a_preset_that_is_not_there_is_told_with_its_line():
    with pytest.raises(ConfigError, match=r"^league.toml:2: unknown preset 'alphastart': did you mean alphastar\?"):
        configuration.loads('seed = 1\npreset = "alphastart"\n')


@pytest.mark.slow
def test_alphastars_league_runs_and_says_how_it_stands(tmp_path, capsys):
    """In a game without bodies, which takes a third of the time."""
    changes = (
        "--arena.name", "rock-paper-scissors", "--training.worlds", "64", "--rating.worlds", "64",
        "--rating.episodes_per_pair", "16", "--rating.final_episodes_per_pair", "16", "--steps", "16000",
        "--budget.rating_time", "0s", "--training.opponents.groups", "8",
        "--roles", '[{name = "main", timeout = 4000}, {name = "main_exploiter", timeout = 6000},'
        ' {name = "league_exploiter", timeout = 6000}]',
    )  # fmt: skip
    done = call("run", "--preset", "alphastar", *changes, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "league-data") as store:
        frozen = {p.name: store.snapshots("alphastar", p.name) for p in store.players("alphastar")}
        met = store.meetings("alphastar")
    hunters = [name for name in frozen if "main-exploiter" in name]
    assert len(hunters) == 2
    for name in hunters:
        assert [s.parent for s in frozen[name]][:3] == [None, f"{name}@0", f"{name}@0"]
        against = {m.opponent.partition("@")[0] for m in met if m.player == name}
        assert against == {"red" if name.startswith("blue") else "blue"}
    assert all(len(frozen[name]) > 3 for name in ("blue", "red"))
    where = ("--store", str(tmp_path / "league-data"))
    assert status([*where]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "blue-main-exploiter (main_exploiter) since blue-main-exploiter@" in told
    assert "then it is reset to its first policy, with probability 0.25" in told
    assert explain(["blue-main-exploiter", "--format", "json", *where]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["role"], found["kind"]) == ("main_exploiter", "exploit")


@pytest.mark.parametrize(
    ("name", "gamma", "gae_lambda", "rollout_length", "shaping"),
    [
        ("sumo-by-team", 0.995, 0.95, 48, 0), ("sumo-within-team", 0.995, 0.98, 120, 0),
        ("soccer-1v1", 0.997, 0.99, 240, 60_000_000), ("soccer-2v2", 0.995, 0.99, 240, 0),
        ("galaga-1v1", 0.995, 0.95, 48, 0), ("galaga-2v2", 0.995, 0.95, 48, 0),
    ],
)  # fmt: skip
def test_matches_of_harl_a_have_the_learner_with_which_its_figures_were_reached(
    name, gamma, gae_lambda, rollout_length, shaping
):
    config, (*alone, match) = presets.preset(name), stages(name)
    assert (match.learner.lr, match.learner.critic_lr, match.learner.gamma) == (3e-4, 1e-3, gamma)
    assert (match.training.rollout_length, match.training.shaping_duration) == (rollout_length, shaping)
    assert match.learner.gae_lambda == gae_lambda
    assert {each.learner.gae_lambda for each in alone if not each.league.endswith("-far")} == {0.95}
    assert alone[0].learner == config.learner
    assert alone[0].training.rollout_length == config.training.rollout_length
    assert match.budget.steps == 500_000_000


def test_robots_of_the_quick_start_share_an_actor_and_those_of_the_default_do_not():
    assert presets.preset("quickstart").learner.share_actors
    assert presets.preset("rovers").learner.share_actors
    assert not configuration.default().learner.share_actors


def stages(name: str) -> list[configuration.Config]:
    """The leagues of a preset's stages."""
    config = presets.preset(name)
    return [configuration.stage(config, number) for number in range(len(config.stages))]


def test_galaga_of_one_begins_before_the_tank_aims_well_and_plays_a_history_in_sight():
    aim, fly, match = stages("galaga-1v1")
    assert (aim.budget.steps, aim.budget.success) == (3_000_000, None)
    assert aim.arena.buffer == fly.arena.buffer == match.arena.buffer == 8
    assert match.arena.rich
    assert (match.training.opponents.kind, match.training.opponents.past) == ("uniform", 0.5)
    assert (match.training.schedule.kind, match.training.schedule.until_score) == ("leapfrog", 0.8)


def test_galaga_of_two_learns_together_from_even_starts_by_a_narrow_ray():
    aim, fly, match = stages("galaga-2v2")
    assert (aim.budget.steps, aim.budget.success) == (1_500_000, None)
    assert aim.arena.buffer == fly.arena.buffer == match.arena.buffer == 14
    assert match.arena.rich
    assert match.arena.rules.ray == 0.5
    assert (match.training.opponents.kind, match.training.opponents.past) == ("uniform", 0.5)
    assert match.training.schedule.kind == "simultaneous"
