"""When players have learnt enough by their ratings, and which of their snapshots is handed on."""

from dataclasses import replace

import numpy as np
import pytest

from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig
from league.commands.run.background import _handed_on
from league.config import experiment as configuration
from league.config import presets
from league.config.schema import ConfigError
from league.config.sections import Budget
from league.scheduling import curriculum, match_scheduler, turn_scheduler
from league.scheduling.training_progress import best, handed_on, learnt_enough, rated, why
from league.snapshots.codec import freeze
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.warm_start import Source, WarmStart
from league.state.league_state import LeagueState
from matchmaking.schedule import Schedule
from storage.blobs import arrays
from storage.records import Checkpoint, Match, PairCounts
from tests.league.leagues import filled, finish, snapshot
from tests.league.plans import KEY, MORE, PLAYERS, checkpoints, league_state, snapshots, training

GAMES = 400
AT = (0, 1, 2, 4, 8, 16, 32)


def played(won: dict[int, float], player: str = "blue", games: int = GAMES) -> list[Match]:
    """Snapshots of a player (by iteration) that have won this share of games against its initial one."""
    return [
        Match(
            "quickstart",
            KEY,
            f"{player}@{i}",
            f"{player}@0",
            n,
            0,
            games - n,
            0,
            n // 2,
            0,
            (games - n) // 2,
            PairCounts(),
            1,
        )
        for i, share in won.items()
        for n in [round(share * games)]
    ]


def after(*matches: list[Match], at=AT, **given) -> LeagueState:
    log = [match for each in matches for match in each]
    return league_state(log, checkpoints=checkpoints(at[-1]), snapshots=snapshots(*at), **given)


def names(found) -> list[str]:
    return [each.snapshot.name for each in found]


def test_a_snapshot_is_rated_once_it_has_played_its_quota_against_those_that_tell():
    state = after(played({1: 0.5, 2: 0.6}), played({4: 0.7}, games=100))
    assert names(rated(state, "blue", quota=128)) == ["blue@1", "blue@2"]
    assert names(rated(state, "blue", quota=100)) == ["blue@1", "blue@2", "blue@4"]
    assert rated(state, "red", quota=1) == []
    assert best([]) is None


def test_the_best_is_the_surest_and_not_the_luckiest():
    state = after(played({2: 0.7}), played({4: 0.8}, games=10))
    found = best(rated(state, "blue", quota=10))
    assert found is not None
    assert found.snapshot.name == "blue@2"
    assert str(found) == "blue@2 scores 70 % (65-74 %) against its initial snapshot"


def test_a_perfect_record_is_better_than_one_with_a_draw_and_ends_no_worse():
    def pairs(player: str, won: int, drawn: int) -> Match:
        counts = PairCounts(ww=won, dw=drawn)
        return Match("quickstart", KEY, player, "blue@0", 2 * won + drawn, drawn, 0, 0, won + drawn, 0, 0, counts, 1)

    state = after([pairs("blue@1", 64, 0), pairs("blue@2", 63, 1), pairs("blue@4", 64, 0)])
    one, drawn, _ = rated(state, "blue", quota=128)
    assert one.score.low < drawn.score.low  # of games that were all won nobody knows how independent they are
    found = best([one, drawn])
    assert found is not None
    assert found.snapshot.name == "blue@1"
    assert why(Budget(plateau=2), 128, state, PLAYERS[0]) == (
        "blue@1 scores 100 % (94-100 %) against its initial snapshot, and none of the 2 snapshots after it is better"
    )


BUDGET = Budget(score=0.8, plateau=3, steps=10**9)


@pytest.mark.parametrize(
    ("won", "told"),
    [
        ({1: 0.5, 2: 0.6, 4: 0.7}, None),  # it still learns
        ({1: 0.5, 2: 0.82}, None),  # not surely
        ({1: 0.5, 2: 0.9}, "blue@2 scores 90 % (87-93 %) against its initial snapshot"),
        ({1: 0.5, 2: 0.9, 4: 0.7}, "blue@2 scores 90 %"),  # one that was surely good stays so
        ({1: 0.5, 2: 0.5, 4: 0.5, 8: 0.5, 16: 0.5}, None),  # it has not begun to learn
        ({1: 0.6, 2: 0.7, 4: 0.69, 8: 0.7}, None),
        ({1: 0.6, 2: 0.7, 4: 0.69, 8: 0.6, 16: 0.68}, "blue@2 scores 70 % (65-74 %) against its initial snapshot, and"),
        ({1: 0.6, 2: 0.7, 4: 0.69, 8: 0.6, 16: 0.72}, None),  # better again
        ({1: 0.6, 2: 0.7, 4: 0.7, 8: 0.6, 16: 0.7}, "blue@2 scores 70 % (65-74 %) against its initial snapshot, and"),
    ],
)
def test_a_player_has_learnt_when_it_surely_scores_or_gets_no_better(won, told):
    (blue, _), state = PLAYERS, after(played(won))
    found = why(BUDGET, 128, state, blue)
    assert found is None if told is None else found is not None and found.startswith(told)
    assert why(Budget(steps=10**9), 128, state, blue) is None


def test_a_player_that_always_wins_reaches_a_plateau_and_hands_its_newest_state_on():
    state = after(played({1: 0.6, 2: 1.0, 4: 1.0, 8: 1.0, 16: 1.0, 32: 1.0}))
    found = why(Budget(plateau=4), 128, state, PLAYERS[0])
    assert found is not None
    assert found.startswith("blue@2 scores 100 %")
    assert found.endswith("and none of the 4 snapshots after it is better")
    assert why(Budget(plateau=5), 128, state, PLAYERS[0]) is None
    assert handed_on(state, "blue") is None


def against_script(won: dict[int, float]) -> list[Match]:
    """Snapshots of blue that have won this share of games against the script of the pool."""
    return [replace(match, b="pusher") for match in played(won)]


def test_a_score_against_scripts_ends_training_where_the_budget_names_them():
    (blue, _), by_script = PLAYERS, Budget(score=0.8, against=("pusher",))
    weak, strong = after(played({2: 0.9}), against_script({2: 0.5})), after(played({2: 0.5}), against_script({2: 0.9}))
    assert why(BUDGET, 128, weak, blue) is not None
    assert why(by_script, 128, weak, blue) is None
    assert why(BUDGET, 128, strong, blue) is None
    assert why(by_script, 128, strong, blue) == "blue@2 scores 90 % (87-93 %) against pusher"
    assert "when each scores 80% against pusher" in curriculum.until(replace(training(), budget=by_script))


def test_the_snapshot_handed_on_is_the_best_against_those_that_the_budget_names():
    state = after(played({2: 0.6, 16: 0.7, 32: 0.9}), against_script({2: 0.95, 16: 0.7, 32: 0.8}))
    assert handed_on(state, "blue") is None
    assert handed_on(state, "blue", against=("pusher",)).snapshot.name == "blue@2"
    config = replace(training(), budget=Budget(score=0.8, against=("pusher",)))
    told = " Handed on instead of the newest: blue@2 scores 95 % (92-97 %) against pusher."
    assert _handed_on(config, state) == told


IDLE, TANK = (snapshot(None, 0, name="idle", roster=roster) for roster in ("rover", "tank"))
BOTH = Budget(score=0.6, against=("idle", "pusher"))


def against_two(idle: dict[int, float], pusher: dict[int, float], games: int = 128, **given) -> LeagueState:
    """A league whose blue snapshots have won these shares of games against two scripts; a third one fits no team."""
    log = [replace(m, b="idle") for m in played(idle)] + [replace(m, b="pusher") for m in played(pusher, games=games)]
    others = replace(TANK, name="idle-tank"), IDLE
    return league_state(log, checkpoints=checkpoints(32), snapshots=(*others, *snapshots(*AT)), **given)


def test_of_several_opponents_a_snapshot_meets_each_and_the_mean_of_its_scores_counts():
    blue, against = PLAYERS[0], BOTH.against
    assert why(BOTH, 128, against_two({4: 1.0}, {}), blue) is None
    assert why(BOTH, 128, against_two({4: 1.0}, {4: 1.0}, games=127), blue) is None
    assert why(BOTH, 128, against_two({4: 1.0}, {4: 0.0}), blue) is None  # 76 % of all games, but 50 % on average
    told = "blue@4 scores 75 % (70-79 %) against idle, pusher"
    assert why(BOTH, 128, against_two({4: 1.0}, {4: 0.5}), blue) == told
    half_met = against_two({4: 1.0, 32: 1.0}, {32: 0.7})
    assert names(rated(half_met, "blue", 128, against)) == ["blue@32"]
    assert handed_on(half_met, "blue", against=against) is None
    assert (
        handed_on(against_two({4: 1.0, 32: 1.0}, {4: 0.9, 32: 0.7}), "blue", against=against).snapshot.name == "blue@4"
    )


def test_an_opponent_whose_match_was_set_aside_is_not_awaited():
    config = replace(training(), budget=BOTH)
    state = against_two({32: 1.0}, {})
    jobs = [match_scheduler.rating_job(config, state, [("blue@32", name)], None) for name in ("pusher", "idle")]
    aside = [replace(state, jobs=(replace(job, state="failed"),)) for job in jobs]
    assert why(BOTH, 128, aside[0], PLAYERS[0]) == "blue@32 scores 100 % (99-100 %) against idle"
    assert why(BOTH, 128, aside[1], PLAYERS[0]) is None  # pusher is still awaited
    alone = replace(against_two({}, {}), jobs=aside[0].jobs + aside[1].jobs)
    assert why(BOTH, 128, alone, PLAYERS[0]) is None  # nothing is known
    begun = replace(against_two({32: 1.0}, {32: 0.0}, games=4), jobs=aside[0].jobs)
    assert why(BOTH, 128, begun, PLAYERS[0]) == "blue@32 scores 100 % (99-100 %) against idle"


def test_an_opponent_with_whom_all_episodes_are_void_tells_nothing():
    void = replace(played({32: 0.0}, games=0)[0], b="pusher", voids=128)
    state = against_two({32: 1.0}, {})
    state = replace(state, ladder=state.ladder.extended([void]))
    assert why(BOTH, 128, state, PLAYERS[0]) == "blue@32 scores 100 % (99-100 %) against idle"


def test_unlike_teams_meet_the_initial_snapshots_of_all_players_of_the_others():
    players = tuple(replace(p, roster=f"{p.team} {p.roster}") for p in MORE)
    won = {"red@0": 0.9, "red-2@0": 0.7}

    def after_games_with(*opponents: str) -> LeagueState:
        log = [replace(m, b=name) for name in opponents for m in played({4: won[name]})]
        return league_state(
            log,
            players=players,
            snapshots=snapshots(0, 4, players=players),
            checkpoints=checkpoints(4, players=players),
        )

    assert rated(after_games_with("red@0"), "blue", 128) == []
    assert rated(after_games_with("red-2@0"), "blue", 128) == []
    (found,) = rated(after_games_with(*won), "blue", 128)
    assert str(found) == "blue@4 scores 80 % (77-83 %) against initial opponents"


def test_training_goes_on_until_each_player_has_learnt():
    config = replace(training(), budget=BUDGET)
    one, both = after(played({2: 0.9})), after(played({2: 0.9}), played({4: 0.7, 8: 0.6, 16: 0.6, 32: 0.6}, "red"))
    assert not learnt_enough(config, one, PLAYERS)
    assert turn_scheduler.next_turns(config, one).jobs
    assert curriculum.ended(config, one) is None
    assert learnt_enough(config, both, PLAYERS)
    assert not turn_scheduler.next_turns(config, both).jobs
    ended = curriculum.ended(config, both)
    assert ended is not None
    assert ended.startswith("blue@2 scores 90 % (87-93 %) against its initial snapshot, red@4 scores 70 %")
    assert ended.endswith("and none of the 3 snapshots after it is better")


def test_nobody_waits_for_players_that_never_learn():
    config, state = replace(training(), budget=BUDGET), after(played({2: 0.9}))
    fixed = [PLAYERS[0], replace(PLAYERS[1], role="fixed")]
    assert learnt_enough(config, state, fixed)
    assert not learnt_enough(config, state, fixed[1:])
    frozen = replace(config, training=replace(config.training, schedule=Schedule("frozen", learner=PLAYERS[0].team)))
    assert learnt_enough(frozen, state, PLAYERS)
    rewarded = replace(config, budget=Budget(reward=0.5, steps=10**9))
    assert not learnt_enough(rewarded, state, fixed)


def test_an_older_snapshot_is_handed_on_where_the_newest_are_surely_rated_and_no_better():
    assert handed_on(after(played({2: 0.82, 8: 0.8, 16: 0.7, 32: 0.7})), "blue").snapshot.name == "blue@2"
    assert handed_on(after(played({2: 0.82, 8: 0.8, 16: 0.7})), "blue").snapshot.name == "blue@2"
    assert handed_on(after(played({2: 0.82, 8: 0.8})), "blue") is None  # ratings lag behind training
    assert handed_on(after(played({2: 0.7, 16: 0.72, 32: 0.82})), "blue") is None  # the newest is the best
    assert handed_on(after(), "blue") is None
    gone = after(played({2: 0.82, 8: 0.8, 16: 0.7, 32: 0.7}))
    thinned = [replace(s, thinned=1.0) if s.name == "blue@2" else s for s in gone.snapshots]
    assert handed_on(replace(gone, snapshots=thinned), "blue").snapshot.name == "blue@8"


def test_who_has_ended_a_stage_is_told_with_what_is_handed_on():
    state = after(played({2: 0.82, 16: 0.7, 32: 0.7}))
    told = " Handed on instead of the newest: blue@2 scores 82 % (78-85 %) against its initial snapshot."
    assert _handed_on(training(), state) == told
    assert _handed_on(training(), after()) == ""


def test_the_best_snapshot_is_what_the_next_stage_starts_from(tmp_path):
    config = HappoConfig(Architecture((4,)), normalise_observations=True)
    good, bad, fresh = (HappoLearner((3,), (2,), config, seed) for seed in (1, 2, 3))
    frozen = freeze([{key: tensor.numpy() for key, tensor in policy.items()} for policy in good.export()])
    with filled(tmp_path / "store") as store:
        history = [(2, frozen), (8, b"later"), (16, b"latest")]
        blue = store.players("cup")[0]
        store.add_snapshots([snapshot(blue, i, store.blobs.put(policy)) for i, policy in history])
        newest = Checkpoint("cup", "blue", store.blobs.put(arrays.to_bytes(bad.save())), 500, 16, 5000.0)
        sources = WarmStart((Source("cup", "blue", 0),), ("cup", "blue"))
        finish(store, checkpoints=[newest], bases={"blue": store.checkpoint("cup", "blue").digest})
        assert warm_start.start(store, fresh, sources) == "cup/blue@16"
        assert warm_start.describe({"blue": sources}, store)[0].startswith("blue: actors go on from cup's blue/0;")
        won = {"blue@2": 330, "blue@8": 300, "blue@16": 250}
        finish(store, matches=[replace(m, league="cup") for name, n in won.items()
                               for m in played({int(name[5:]): n / GAMES})])  # fmt: skip
        assert warm_start.start(store, fresh, sources) == "cup/blue@2"
        for name, array in good.export()[0].items():
            np.testing.assert_array_equal(fresh.export()[0][name], array, err_msg=name)
        np.testing.assert_array_equal(fresh.save()["critic.value.weight"], bad.save()["critic.value.weight"])
        assert warm_start.describe({"blue": sources}, store) == [
            "cup hands on blue@2, the best snapshot of blue: it scores 82 % (78-86 %) against its initial snapshot",
            "blue: actors go on from cup's blue@2/0; critic and value normaliser from cup's blue",
        ]


def test_stages_of_pushing_end_when_they_have_been_learnt():
    stages = {
        s.name: configuration.stage(presets.preset("sumo-by-team"), i)
        for i, s in enumerate(presets.preset("sumo-by-team").stages)
    }
    for name in ("push-anymal", "push-leatherback"):
        assert (stages[name].budget.score, stages[name].budget.plateau) == (0.8, 6)
        assert "each scores 80% against idle" in curriculum.until(stages[name])
        assert "the last 6 snapshots are no better" in curriculum.until(stages[name])


def test_what_ends_by_ratings_needs_matches():
    with pytest.raises(ConfigError, match=r"rating.share = 0.0: must be above 0 where budget.plateau is set"):
        configuration.loads("[rating]\nshare = 0.0\n[budget]\nplateau = 3\n")
    with pytest.raises(
        ConfigError, match=r"budget.against = .*: is for budget.score or budget.plateau; set one of them"
    ):
        configuration.loads('[budget]\nsteps = 8\nagainst = ["idle"]\n')
