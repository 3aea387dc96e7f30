"""Teams of equal agents are exchangeable only where the arena declares it, and the check tries what is declared."""

import jax
import jax.numpy as jnp
import pytest

import arenas
from arenas.arena_settings import Timing
from arenas.contract.check import UNLIKE, check_arena
from arenas.contract.check_run import CheckRun
from arenas.contract.exchange_check import exchangeable, problem, sign_test
from arenas.errors import ArenaError
from arenas.robots.puck import PUCK
from arenas.rosters import bare, matching_roster, roster_agents, roster_side
from tests.arenas.chase import ChaseSettings, Mistaken, TagSettings
from tests.arenas.race import Race, RaceRules, RaceSettings

SHORT = RaceSettings(rules=RaceRules(episode=1.0))


class Nearer(Race):
    """Every exchanged situation is fair, but red always starts nearer to the flag."""

    def place(self, key):
        qpos, qvel, flag = super().place(key)
        return qpos.at[7:9].set(flag + 0.6 * (qpos[7:9] - flag)), qvel, flag


class NearerDrawn(Nearer):
    """Nobody ever wins, so that scores say nothing."""

    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(score=jnp.full(2, 0.5))


class OwnGoals(Race):
    """Each team has a flag of its own, and `exchange` does not swap them."""

    def place(self, key):
        qpos, qvel, flag = super().place(key)
        return qpos, qvel, jnp.stack([flag, flag + 1.0])

    def observe(self, physics, game, actions):
        return {f"{team}/0": jnp.tile(game[i], 3) for i, team in enumerate(("blue", "red"))}


class Taxed(Race):
    """Blue pays for time, and the score is fair."""

    def judge(self, before, physics, game):
        game, verdict = super().judge(before, physics, game)
        return game, verdict._replace(shapings=verdict.shapings | {"time": jnp.array([-0.1, 0.0])})


class Undeclared(Race):
    exchangeable = False


def tried(arena):
    return problem(CheckRun(arena, jax.random.key(0)))


def test_equal_teams_that_are_not_declared_exchangeable_have_rosters_of_their_own():
    chaser, runner = ChaseSettings().build(engine="c").teams
    assert (chaser.roster, runner.roster) == ("puck:6:2@chaser", "puck:6:2@runner")
    assert [team.roster for team in SHORT.build(engine="c").teams] == ["puck:6:2"] * 2


def test_the_check_says_that_undeclared_teams_count_as_unlike():
    arena = TagSettings().build()
    assert [(p.name, p.ok) for p in check_arena(arena) if p.name == UNLIKE] == [(UNLIKE, True)]
    arena.exchange_teams()
    assert UNLIKE not in {p.name for p in check_arena(arena)}


def test_a_declaration_that_is_wrong_fails_the_check():
    said = tried(Mistaken(ChaseSettings(), engine="c"))
    assert "result differs, by up to 2 when the teams change places" in said


def test_what_one_side_alone_gets_fails_the_check():
    assert "shaping time differs, by up to 0.5 when the teams change places" in tried(Taxed(SHORT, engine="c"))


def test_a_start_that_favours_a_side_fails_the_check_by_the_scores():
    said = tried(Nearer(RaceSettings(rules=RaceRules(episode=4.0)), engine="c"))
    assert "one policy in all teams scores" in said
    assert "as blue" in said


def test_a_start_that_favours_a_side_fails_the_check_if_all_games_are_draws():
    said = tried(NearerDrawn(SHORT, engine="c"))
    assert "at the start number" in said
    assert "for blue/0 and" in said


def test_the_check_names_the_hook_that_swaps_what_a_game_keeps_by_team():
    said = tried(OwnGoals(SHORT, engine="c"))
    assert "the observation of blue/0 differs" in said
    assert "override `exchange()`" in said


def test_a_fair_start_passes():
    assert tried(Race(SHORT, engine="c")) == ""


def test_undeclared_teams_have_nothing_to_keep():
    arena = Undeclared(SHORT, engine="c")
    assert not exchangeable(arena)
    assert tried(arena) == ""


@pytest.mark.parametrize("name", arenas.names())
def test_our_arenas_of_equal_teams_declare_them(name):
    outline = arenas.settings(name).outline()
    if len(outline.teams) == 2:
        blue, red = outline.teams.values()
        arena = arenas.settings(name).build(engine="c", threads=1)
        assert (arena.teams[0].roster == arena.teams[1].roster) == (blue == red)


def test_a_league_made_so_can_have_its_teams_taken_for_exchangeable():
    arena = ChaseSettings().build(engine="c")
    assert arena.teams[0].roster != arena.teams[1].roster
    arena.exchange_teams()
    assert [team.roster for team in arena.teams] == ["puck:6:2"] * 2


def test_more_than_eight_teams_are_refused_in_one_line():
    class Crowd(Race):
        def __init__(self, teams):
            super(Race, self).__init__("crowd", dict.fromkeys(teams, (PUCK,)), Timing(), {}, engine="c")

    assert len(Crowd("abcdefgh").teams) == 8
    with pytest.raises(
        ArenaError, match=r"^9 teams \(a, b, c, d, e, f, g, h, i\): an arena has at most 8; leave some out$"
    ):
        Crowd("abcdefghi")


def test_rosters_are_read_with_and_without_a_side():
    roster = "ant:5:2+bee:6:3@chaser"
    assert (roster_side(roster), bare(roster), roster_agents(roster)) == (
        "chaser",
        "ant:5:2+bee:6:3",
        ["ant:5:2", "bee:6:3"],
    )
    assert (roster_side("ant:5:2"), bare("ant:5:2"), roster_agents("ant:5:2")) == ("", "ant:5:2", ["ant:5:2"])


@pytest.mark.parametrize(
    ("roster", "sides", "found"),
    [
        ("ant:5:2", ["ant:5:2", "bee:6:3"], "ant:5:2"),
        ("ant:5:2@runner", ["ant:5:2@chaser", "ant:5:2@runner"], "ant:5:2@runner"),
        ("ant:5:2@runner", ["ant:5:2", "ant:5:2"], "ant:5:2"),
        ("ant:5:2", ["ant:5:2@chaser", "ant:5:2@runner"], None),
        ("ant:5:2@prey", ["ant:5:2@chaser", "ant:5:2@runner"], None),
        ("bee:6:3", ["ant:5:2"], None),
    ],
)
def test_a_policy_plays_the_side_it_fits(roster, sides, found):
    assert matching_roster(roster, sides) == found


@pytest.mark.parametrize(
    ("points", "chance"),
    [([], 1.0), ([0.0] * 9, 1.0), ([0.5] * 8, 2 / 256), ([0.5, -0.5], 1.0), ([0.5] * 7 + [-0.5], 18 / 256)],
)
def test_how_likely_chance_explains_a_lean(points, chance):
    assert sign_test(points) == pytest.approx(chance)
