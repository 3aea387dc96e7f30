"""Lives of players: what ends them, and that who begins anew was frozen before."""

from dataclasses import replace

import numpy as np
import pytest

from league.config import experiment as configuration
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.queries.opponents import explain_opponents
from league.scheduling import turn_scheduler
from league.scheduling.player_resets import current_generation
from league.snapshots.codec import thaw
from league.state.jobs import decode
from league.state.league_state import LeagueState
from matchmaking.opponents import Opponents
from matchmaking.roles import LEAGUE_EXPLOITER, MAIN_EXPLOITER, Role
from storage.blobs import arrays
from storage.records import League, Player
from storage.store import Store
from tests.league.leagues import BLUE, chain, games, player, snapshot
from tests.league.turns import LEAGUE, claim, ends, new_trainer, settings, turns

HUNTER = replace(player("hunter", 1, group="2"), role="main_exploiter")
ROVER = replace(player("rover", 0, group="3"), role="league_exploiter")


def league_state(*meetings, players=(BLUE, HUNTER, ROVER)):
    frozen = [snapshot(HUNTER, 0), snapshot(ROVER, 0), snapshot(ROVER, 1, parent="rover@0"), *chain(BLUE)]
    return LeagueState(players, frozen, meetings=meetings)


def hunts(*meetings, steps=500):
    role = replace(MAIN_EXPLOITER, timeout=1000)
    return current_generation(role, league_state(*meetings), HUNTER, steps)


def test_a_life_ends_when_all_whom_it_meets_are_surely_beaten():
    beats = games("blue@4", 95, 5, who="hunter")
    assert set(hunts().scores) == {"blue@4"}  # no league exploiter of that team, and of a main player the newest
    assert hunts(beats).over
    assert not hunts(games("blue@4", 74, 26, who="hunter")).over  # above 70 %, and not surely
    assert not hunts(games("blue@4", 4, 0, who="hunter")).over  # nor after four games
    assert not hunts(games("blue@4", 95, 5, who="hunter", iteration=0)).over  # of the life before
    assert hunts(games("blue@2", 95, 5, who="hunter")).over  # blue@4 goes on from it
    whole = current_generation(
        replace(LEAGUE_EXPLOITER, timeout=1000), league_state(replace(beats, player="hunter")), HUNTER, 500
    )
    assert set(whole.scores) == {"blue@0", "blue@1", "blue@2", "blue@4", "rover@0", "rover@1"}
    assert not whole.over


def test_a_life_ends_with_its_timeout_counted_from_the_newest_snapshot():
    assert [hunts(steps=n).left for n in (0, 999, 1000, 1001)] == [1000, 1, 0, 0]
    assert [hunts(steps=n).over for n in (0, 999, 1000, 1001)] == [False, False, True, True]
    role = replace(LEAGUE_EXPLOITER, timeout=1000)
    assert current_generation(role, league_state(), ROVER, 1099).left == 1  # rover@1 was frozen at step 100
    assert current_generation(Role("main"), league_state(), BLUE, 5) is None


def test_a_policy_is_as_old_as_the_last_snapshot_after_which_it_began_anew():
    role, history = replace(LEAGUE_EXPLOITER, reset_chance=0.5), [snapshot(ROVER, i) for i in range(9)]
    anew = [s.iteration for s in history[1:] if role.reset_after(1, "rover", s.iteration)]
    assert 0 < len(anew) < 8
    assert role.last_reset(1, "rover", history) is history[anew[-1]]
    assert MAIN_EXPLOITER.last_reset(1, "rover", history[:1]) is None  # its initial one ended no life


# Turns ---------------------------------------------------------------------------------------------------------------

STEPS = 16 * 8  # of an iteration


@pytest.fixture(scope="module")
def arena():
    return configuration.default("rock-paper-scissors").arena.build()


def hunting(*roles, opponents=Opponents(), **changes):  # noqa: B008  (frozen)
    """Blue and red are main players, and red has an exploiter in a group of its own."""
    config = settings(opponents=opponents)
    training = replace(config.training, **changes)
    config = replace(config, arena=configuration.default("rock-paper-scissors").arena, training=training)
    players = tuple(
        PlayerSettings(p.team, p.name, p.role, p.group)
        for p in (
            PlayerSettings("blue", "blue", "main", "1"),
            PlayerSettings("red", "red", "main", "1"),
            PlayerSettings("red", "hunter", roles[0].name if roles else "main_exploiter", "2"),
        )
    )
    return replace(config, players=players, roles=roles)


def made(place, arena, config):
    store = Store.open(place, create=True)
    store.create_league(League(LEAGUE, ""))
    teams = [team.name for team in arena.teams]
    rows = [Player(LEAGUE, p.name, teams.index(p.team), p.role, arena.teams[0].roster, p.group) for p in config.players]
    store.add_players(rows)
    return store


def state(store, name, iteration):
    row = next(c for c in store.checkpoints(LEAGUE) if (c.player, c.iteration) == (name, iteration))
    return arrays.from_bytes(store.blobs.get(row.digest))


@pytest.mark.slow
def test_an_exploiter_is_frozen_and_then_begins_anew_however_often_it_is_killed(arena, tmp_path):
    config = hunting(Role("main_exploiter", timeout=2 * STEPS), iterations_per_turn=4)
    with made(tmp_path / "a", arena, config) as store:
        lost = turns(store, config, arena, 4)
        assert [c.iteration for c in store.checkpoints(LEAGUE) if c.player == "hunter"] == [0, 2]
        while True:
            lease, turn = claim(store, config)
            for _ in lost.turn(store, turn, lambda: False):
                pass
            if turn.group == "2":
                break
            lost.commit(store, lease, turn)
        assert lost._finalizer._frozen  # its second life was over
        store.release(lease)  # killed before anything of it was written
        assert [s.name for s in store.snapshots(LEAGUE, "hunter")] == ["hunter@0", "hunter@2"]
        turns(store, config, arena, 3)

        frozen = store.snapshots(LEAGUE, "hunter")
        assert [(s.name, s.parent) for s in frozen[:3]] == [
            ("hunter@0", None), ("hunter@2", "hunter@0"), ("hunter@4", "hunter@0"),
        ]  # fmt: skip
        first, second, third = (thaw(store, s, arena)[0] for s in frozen[:3])
        assert any((first[k] != second[k]).any() for k in first)  # what it had learnt
        assert any((second[k] != third[k]).any() for k in first)
        for iteration in (2, 4):
            after = state(store, "hunter", iteration)
            for key, weights in first.items():
                np.testing.assert_array_equal(after[f"actor.0.{key}"], weights, err_msg=key)
            assert all((after[k] == 0).all() for k in after if k.startswith("adam.") and k.endswith("exp_avg"))
            np.testing.assert_array_equal(
                after["critic.value.weight"], state(store, "hunter", 0)["critic.value.weight"]
            )
        assert (state(store, "hunter", 2)["rng"] != state(store, "hunter", 0)["rng"]).any()
        met = {m.opponent for m in store.meetings(LEAGUE) if m.player == "hunter"}
        assert met <= {s.name for s in store.snapshots(LEAGUE, "blue")}
        kept, reached, done = store.snapshots(LEAGUE), ends(store), len(store.jobs(LEAGUE, "done"))
    with made(tmp_path / "b", arena, config) as other:
        turns(other, config, arena, done)
        assert ends(other) == reached
        assert {(s.name, s.digest, s.parent) for s in other.snapshots(LEAGUE)} == {
            (s.name, s.digest, s.parent) for s in kept
        }


def test_who_begins_anew_has_its_dense_reward_again_and_its_old_games_forgotten(arena, tmp_path):
    config = hunting(Role("main_exploiter", timeout=2 * STEPS), shaping_steps=4 * STEPS)
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 9)
        told = [p.values["shaping_weight"] for p in store.curves(LEAGUE, "hunter")]
        assert told[:4] == pytest.approx([0.75, 0.5] * 2)
        assert [p.values["shaping_weight"] for p in store.curves(LEAGUE, "blue")][:4] == [0.75, 0.5, 0.25, 0]


def test_a_role_may_fade_the_dense_reward_otherwise_than_the_league(arena, tmp_path):
    """An exploiter that is paid for the outcome alone beside main players with a dense reward that fades."""
    config = hunting(Role("main_exploiter", timeout=2 * STEPS, shaping_steps=0), shaping_until=0.9)
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 5)
        assert {p.values["shaping_weight"] for p in store.curves(LEAGUE, "hunter")} == {0.0}
        assert store.curves(LEAGUE, "blue")[0].values["shaping_weight"] > 0
        kept = {c.player: arrays.from_bytes(store.blobs.get(c.digest)) for c in store.checkpoints(LEAGUE)}
        assert {name for name, arrays_of in kept.items() if "shaping.weight" in arrays_of} == {"blue", "red"}


def test_a_reset_may_be_to_the_newest_main_player_of_the_team(arena, tmp_path):
    config = hunting(Role("veteran", Opponents("uniform"), timeout=STEPS, reset="main"))
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 6)
        (_, end, last), mains = store.snapshots(LEAGUE, "hunter")[:3], store.snapshots(LEAGUE, "red")
        assert last.parent in {s.name for s in mains}
        taken = next(s for s in mains if s.name == last.parent)
        after, policy = state(store, "hunter", end.iteration), thaw(store, taken, arena)[0]
        for key, weights in policy.items():
            np.testing.assert_array_equal(after[f"actor.0.{key}"], weights, err_msg=key)


def test_a_role_without_reset_goes_on_and_is_frozen_by_its_steps(arena, tmp_path):
    config = hunting(Role("main_exploiter", timeout=10**6), Role("main", timeout=3 * STEPS), iterations_per_turn=2)
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 14)
        assert [s.iteration for s in store.snapshots(LEAGUE, "blue")][:3] == [0, 3, 6]
        assert [s.name for s in store.snapshots(LEAGUE, "hunter")] == ["hunter@0"]
        assert store.snapshots(LEAGUE, "blue")[2].parent == "blue@3"


def test_a_fixed_player_never_learns(arena, tmp_path):
    config = hunting(Role("main_exploiter"))
    config = replace(config, players=(config.players[0], replace(config.players[1], role="fixed")))
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 3)
        assert {name: i for name, (i, _) in ends(store).items()} == {"blue": 2, "red": 0}
        assert len([c for c in store.checkpoints(LEAGUE) if c.player == "red"]) == 1


def test_who_has_a_rule_of_its_own_learns_from_its_own_worlds_alone(arena, tmp_path):
    config = hunting(Role("veteran", Opponents("uniform", groups=3)))
    config = replace(config, players=(config.players[0], replace(config.players[1], role="veteran")))
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 2)
        share = {name: store.curves(LEAGUE, name)[-1].values["past_share"] for name in ("blue", "red")}
        assert share == {"blue": 0, "red": 1}
        assert {m.opponent for m in store.meetings(LEAGUE) if m.player == "red"} == {"blue@0"}
        assert {m.opponent for m in store.meetings(LEAGUE) if m.player == "blue"} <= {"red"}


def test_each_player_has_the_share_of_past_opponents_that_is_told(arena, tmp_path):
    often, seldom = Opponents("uniform", past=0.75, groups=4), Opponents("uniform", past=0.25, groups=4)
    config = hunting(Role("veteran", often), Role("novice", seldom))
    blue, red, _ = config.players
    config = replace(config, players=(replace(blue, role="novice"), replace(red, role="veteran")))
    with made(tmp_path, arena, config) as store:
        turns(store, config, arena, 3)
        state = LeagueState.of(store, LEAGUE)
        for player in state.players:
            told = explain_opponents(config.role(player.role), state, player)["share"]
            assert told == {"blue": 0.25, "red": 0.75}[player.name]
            assert store.curves(LEAGUE, player.name)[-1].values["past_share"] == told


def test_all_players_are_made_before_one_learns_and_deterministic_groups_take_turns(arena, tmp_path):
    config = hunting()
    with made(tmp_path, arena, config) as store:
        trainer, order = new_trainer(config, arena, store), []
        for _ in range(6):
            (job,) = turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE)).jobs
            order.append((decode(job).group, decode(job).iterations > 0))
            lease, turn = claim(store, config)
            assert not turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE)).jobs  # one at a time
            for _ in trainer.turn(store, turn, lambda: False):
                pass
            trainer.commit(store, lease, turn)
        assert order[:2] == [("1", False), ("2", False)]
        assert {group for group, _ in order[2:]} == {"1", "2"}
        both = replace(config, deterministic=False)
        assert [decode(job).group for job in turn_scheduler.next_turns(both, LeagueState.of(store, LEAGUE)).jobs] == [
            "1",
            "2",
        ]


def test_a_role_that_is_not_there_is_refused_with_what_is(tmp_path):
    text = 'arena.name = "matching-pennies"\n[[players]]\nteam = "blue"\nrole = "boss"\n'
    with pytest.raises(ConfigError, match=r"players: there is no role 'boss'; use one of main, main_exploiter"):
        configuration.loads(text)
    text = 'arena.name = "matching-pennies"\n[[roles]]\nname = "main_exploiter"\nwin_rate = 1.5\n'
    with pytest.raises(ConfigError, match=r"^league.toml:4: roles\[0\].win_rate = 1.5: lies above 0"):
        configuration.loads(text)
    own = '[[roles]]\nname = "main_exploiter"\ntimeout = 5000\n[roles.opponents]\nkind = "latest"\n'
    read = configuration.loads(own)
    assert read.role("main_exploiter").opponents == Opponents("latest")
    assert configuration.loads(configuration.dumps(read)) == read
