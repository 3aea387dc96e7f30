"""The line that `league run` prints while it runs, and what it says at its end."""

import os
import socket
from dataclasses import replace

import numpy as np
import pytest

from league.commands import status_line
from league.commands.options import STORE
from league.commands.run import summary as module
from league.commands.run.summary import summary
from league.commands.status_line import Ticker
from league.config import presets
from league.config.experiment import Budget
from league.state.league_state import LeagueState
from matchmaking.ratings import ladder as ladders
from matchmaking.ratings.fit import fit
from matchmaking.ratings.ladder import Ladder
from storage.records import Job, Phase, RankedMatch, Worker
from tests.league.leagues import match, player, snapshot

QUICKSTART = presets.preset("quickstart")
HERE, ME = socket.gethostname(), os.getpid()
PLAYERS = [player(name, team) for team, name in enumerate(("blue", "red"))]
SAID = {
    "doing": "training", "learners": ["blue", "red"], "iteration": 640, "steps": 5_242_880, "seconds": 240.0,
    "steps_per_second": 3700.0,
}  # fmt: skip


def worker(kinds="train", pid=ME, started=10.0, **status) -> Worker:
    return Worker(f"{HERE}:{pid}:{kinds}0", "cup", kinds, pid, HERE, status, started, 99.0)


def league_state(*log, players=PLAYERS, **given) -> LeagueState:
    pool = [snapshot(p, i) for i in (0, 1, 64) for p in players]
    pool.append(snapshot(None, 0, name="pusher"))
    return LeagueState(
        players=players, snapshots=pool,
        ladder=Ladder([s.name for s in pool], log, [s.name for s in pool if s.initial]), **given
    )  # fmt: skip


def ticker(**budget) -> Ticker:
    return Ticker(replace(QUICKSTART, budget=Budget(**budget)))


MANAGER = worker("manager")
PLAYED = [match("blue@64", "blue@0", 97, 3), match("red@64", "red@0", 96, 4), match("blue@1", "blue@0", 5, 5)]


def test_what_matters_most_comes_first_and_the_line_is_at_most_80_columns():
    line = ticker(training_time="2h").line(league_state(*PLAYED), "training", [MANAGER, worker(**SAID)])
    assert line.startswith("blue@64 97 %, red@64 96 % vs initial · 1:56:00 left · blue+red learn")
    assert len(line) <= 80


@pytest.mark.parametrize("width", range(0, 200, 7))
def test_a_narrow_line_leaves_parts_out_and_cuts_none(width):
    tell, state, said = ticker(training_time="5m"), league_state(*PLAYED), [MANAGER, worker(**SAID)]
    whole = tell.line(state, "training", said, 500).split(" · ")
    line = tell.line(state, "training", said, width)
    assert len(line) <= width
    assert {part for part in line.split(" · ") if part and "so far" not in part} <= set(whole)
    assert len(whole) == 8


def test_before_anything_is_rated_it_tells_how_learning_goes():
    line = ticker().line(league_state(), "training", [MANAGER, worker(**SAID)])
    assert line.startswith("blue+red learn · iteration 640 · 5,242,880 steps · 3,700 steps/s · ")


def test_in_a_file_an_equal_line_is_added_only_after_growing_pauses(monkeypatch, capsys):
    now = 0.0
    monkeypatch.setattr(status_line.time, "monotonic", lambda: now)
    tell, printed, later = ticker(rating_time="10m"), [], (*PLAYED, match("blue@64", "red@64", 9, 1))
    for now in np.arange(5.0, 605.0, 5.0):
        tell(league_state(*(PLAYED if now < 400 else later)), "rating", [MANAGER])
        printed += [now] * len(capsys.readouterr().out.splitlines())
    assert printed == [5, 15, 35, 75, 135, 195, 255, 315, 375, 400, 410, 430, 470, 530, 590]
    tell(league_state(*later), "done", [MANAGER])
    assert capsys.readouterr().out.startswith("done")


def test_a_budget_in_steps_is_told_as_time():
    line = ticker(steps=5_242_880 + 3700 * 90).line(league_state(), "training", [worker(**SAID)])
    assert line.startswith("1:30 left")


def test_a_manager_without_train_workers_waits_for_those_of_others():
    waits = ticker()
    waits.config = replace(waits.config, workers=replace(waits.config.workers, train=0))
    assert waits.line(league_state(), "training", [MANAGER]).startswith("waiting for a `league worker` that trains")


def test_a_worker_that_joined_for_all_jobs_learns_too():
    own, joined = worker(doing="waiting"), worker("train+match", **SAID)
    line = ticker().line(league_state(), "training", [MANAGER, own, joined])
    assert line.startswith("blue+red learn · iteration 640 · 5,242,880 steps")
    joined = worker("train+match", doing="compiling the training rollout")
    assert ticker().line(league_state(), "training", [MANAGER, own, joined]).startswith("compiling the training")
    idle = [MANAGER, worker("match", doing="waiting")]
    assert ticker().line(league_state(), "training", idle).startswith("starting workers")


def test_after_a_restart_no_dead_workers_words_are_shown():
    gone = next(pid for pid in range(4_000_000, 5_000_000) if not os.path.exists(f"/proc/{pid}"))
    old = worker(started=5.0, **SAID)
    line = ticker().line(league_state(), "training", [MANAGER, old, worker(pid=gone, started=11.0, **SAID)])
    assert line.startswith("starting workers")
    new = worker(started=11.0, doing="compiling the training rollout")
    assert ticker().line(league_state(), "training", [MANAGER, old, new]).startswith("compiling the training rollout")


def test_many_players_and_groups_are_told_together():
    many = [player(f"{team}-{i}", t, group=str(i)) for i in range(3) for t, team in enumerate(("blue", "red"))]
    log = [match(f"{p.name}@64", f"{p.name}@0", 90 + 2 * i, 10 - 2 * i) for i, p in enumerate(many[:4])]
    workers = [worker(**SAID), worker(**SAID)]
    line = ticker(training_time="5m").line(league_state(*log, players=many), "training", workers)
    assert line.startswith("newest rated of 4 players 90-96 % vs initial (2 newest not yet) · 1:00 left")


def test_while_rating_it_tells_how_long_that_will_take(monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(status_line.time, "monotonic", lambda: now[0])
    phase = Phase("cup", "(rating)", 4, (), {}, {"seconds": 175.0, "budget": 180.0})
    tell, state = ticker(rating_time="3m"), league_state(*PLAYED, phases={"(rating)": phase})
    assert tell.line(state, "rating", []).startswith(
        "rating · blue@64 97 %, red@64 96 % vs initial · 2:55 left · 210 rated"
    )
    now[0] += 60
    assert "1:55 left" in tell.line(state, "rating", [])
    now[0] += 115
    assert "vs initial · the last batch is being played" in tell.line(state, "rating", [])


def test_at_the_end_it_tells_what_is_waited_for():
    rates = worker("match", doing="rating, 10 % of the last 30 s", pairs=8)
    tell, state = ticker(), league_state(*PLAYED)
    line = tell.line(state, "ending", [MANAGER, worker(**SAID), rates])
    assert line.startswith("ending · finishing an iteration and a batch of matches · ")
    assert tell.line(state, "ending", [MANAGER, worker(**SAID)]).startswith("ending · finishing an iteration · ")
    assert tell.line(state, "ending", [MANAGER, worker("match", doing="waiting")]).startswith("ending · blue@64 97 %")


def test_what_the_league_goes_on_without_is_said():
    players = [PLAYERS[0], replace(PLAYERS[1], paused="its policy was nan twice")]
    bad = Job("cup", "match", "match:1", state="failed", error="ValueError")
    state = league_state(*PLAYED, players=players, jobs=(bad, replace(bad, state="queued")))
    line = ticker(training_time="5m").line(state, "training", [worker(**SAID)])
    assert line.startswith("blue@64 97 %, red@64 96 % vs initial · 1:00 left · 1 job set aside, red paused")

    assert "1 job set aside, red paused: `league status` tells why." in summary(QUICKSTART, state, STORE)
    assert "league status" not in summary(QUICKSTART, league_state(*PLAYED), STORE)


@pytest.mark.parametrize(
    ("store", "said"),
    [
        (STORE, "\nNext:\n  league ratings "),
        ("my runs", "\nNext, each with --store 'my runs':\n  league ratings "),
        ("postgresql://me:secret@host/db", "\nNext, each with --store 'postgresql://me:***@host/db':\n"),
    ],
)
def test_the_next_commands_name_the_store(store, said):
    assert said in summary(QUICKSTART, league_state(*PLAYED), store)


def test_one_team_tells_its_success():
    log = [match("blue@64", None, 30, 10), match("blue@0", None, 1, 39)]
    line = ticker().line(league_state(*log, players=PLAYERS[:1]), "training", [worker(**SAID)])
    assert line.startswith("blue@64 75 % success · ")
    assert "blue@64 succeeds: 75.0 % (" in summary(QUICKSTART, league_state(*log, players=PLAYERS[:1]), STORE)
    early = [match("blue@1", None, 30, 10)]
    assert "blue@64 succeeds: not tried yet" in summary(QUICKSTART, league_state(*early, players=PLAYERS[:1]), STORE)


def test_it_is_printed_as_lines_where_there_is_no_terminal(capsys):
    tell = ticker()
    for stage in ("training", "training", "done"):  # the second one comes too soon
        tell(league_state(), stage, [worker(**SAID)])
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert lines[1].startswith("done")


def test_why_a_player_is_paused_is_printed_once(capsys):
    paused = [PLAYERS[0], replace(PLAYERS[1], paused="my.py:Mine.learn: AttributeError\nand more")]
    tell = ticker()
    for _ in range(2):
        tell(league_state(*PLAYED, players=paused), "ending", [])
    text = capsys.readouterr().out
    assert text.count("Warning: red is paused: my.py:Mine.learn: AttributeError\n") == 1
    assert "and more" not in text


def test_a_summary_fits_once_and_says_who_is_better(monkeypatch):
    fits = []
    monkeypatch.setattr(ladders, "fit", lambda *args, **named: fits.append(1) or fit(*args, **named))
    log = [
        *PLAYED,
        match("blue@64", "red@64", 60, 40),
        match("blue@64", "pusher", 70, 30),
        match("blue@0", "red@0", 9, 9),
    ]
    text = summary(QUICKSTART, league_state(*log), STORE)
    assert len(fits) == 1
    assert "blue@64 against\n  red@64 (1:04 of training)          60.0 % (50.2-69.1) of 100\n  its own blue@0" in text
    assert "  pusher" in text
    assert "red@64 against\n" in text
    assert "\n  not yet against pusher\n" in text
    assert "blue@64 is stronger than red@64: blue@64 scores 60.0 % (50.2-69.1) of 100 against red@64." in plain(text)
    assert text.endswith(module.NEXT)


def test_a_copy_is_said_to_be_the_same_policy():
    log = [match("blue@64", "red@64", 60, 40), match("blue@0", "red@0", 9, 9)]
    state = league_state(*PLAYED, *log)
    copies = [replace(s, digest="one") if s.name in ("blue@64", "red@64") else s for s in state.snapshots]
    text = summary(QUICKSTART, replace(state, snapshots=copies), STORE)
    assert "blue@64 and red@64 are the same policy." in text
    assert "stronger" not in text


def test_who_is_stronger_is_asked_of_one_side_alone():
    rovers = [player("blue", 0), player("blue-2", 0, group="2")]
    log = [match("blue@64", "ants@0", 600, 400), match("blue-2@64", "ants@0", 400, 600)]
    text = plain(summary(QUICKSTART, league_state(*log, players=[*rovers, player("ants", 1, "ant")]), STORE))
    assert "It is not known whether blue@64 or blue-2@64 is stronger: by the ratings blue@64 is " in text
    assert "(the two have not met; ± has room for a cyclic term of 100 Elo)" in text
    assert "Not known yet: how strong ants@64 is." in text
    assert "than ants" not in text
    far = [*log, match("blue@64", "blue-2@0", 980, 20), match("blue-2@64", "blue-2@0", 20, 980)]
    text = plain(summary(QUICKSTART, league_state(*far, players=[*rovers, player("ants", 1, "ant")]), STORE))
    assert "blue@64 is stronger than blue-2@64: by the ratings" in text


def test_the_fit_alone_calls_nobody_stronger_than_whom_it_loses_to():
    """The case of a quick start: the ratings had blue ahead, and 200 games between the two had red ahead."""
    detour = [match("blue@64", "blue@0", 150, 50), match("red@64", "blue@0", 130, 70)]
    text = plain(summary(QUICKSTART, league_state(*detour), STORE))
    assert "It is not known whether blue@64 or red@64 is stronger: by the ratings blue@64 is " in text
    text = plain(summary(QUICKSTART, league_state(*detour, match("blue@64", "red@64", 60, 140)), STORE))
    assert "red@64 is stronger than blue@64: red@64 scores 70.0 % (" in text


def test_every_score_is_of_a_snapshot_that_is_named_and_what_is_newer_is_said_to_wait():
    log = [match("blue@1", "blue@0", 51, 49), match("red@1", "red@0", 50, 50)]
    line = ticker(training_time="2h").line(league_state(*log), "training", [MANAGER, worker(**SAID)])
    assert line.startswith("blue@1 51 %, red@1 50 % vs initial (blue@64, red@64 not yet) · ")
    line = ticker(rating_time="3m").line(league_state(*log, PLAYED[0]), "rating", [])
    assert line.startswith("rating · blue@64 97 %, red@1 50 % vs initial (red@64 not yet) · ")
    line = ticker(rating_time="3m").line(league_state(), "rating", [])
    assert line.startswith("rating · blue@64 and red@64: score vs initial not known yet · 0 rated episodes")
    text = summary(QUICKSTART, league_state(*log), STORE)
    told = "Not known yet: how strong blue@64 and red@64 are. This plays more matches:"
    assert told in plain(text)
    assert f"\n  league rate --store {STORE} --league {QUICKSTART.league} --budget 2m\n" in text
    assert "stronger than" not in text


def plain(text: str) -> str:
    """Without line breaks, so that sentences can be looked for."""
    return " ".join(text.split())


def test_a_line_fits_nothing_at_all(monkeypatch):
    monkeypatch.setattr(ladders, "fit", lambda *_, **__: pytest.fail("the progress line fitted ratings"))
    assert ticker().line(league_state(*PLAYED), "training", [worker(**SAID)])


@pytest.mark.parametrize("teams", [2, 3, 8])
def test_an_episode_of_many_teams_is_one_rated_episode(teams):
    many = [player(name, team) for team, name in enumerate("abcdefgh"[:teams])]
    log = [match("a@64", "b@64", 60, 30, 10)]
    if teams > 2:
        lineup = tuple(f"{p.name}@64" for p in many)
        won = RankedMatch("cup", log[0].arena, lineup, {tuple(range(1, teams + 1)): 1000}, 7, (0,) * teams, seed=1)
        log = [won, replace(won, snapshots=("a@1", *lineup[1:]), rankings={(1,) * teams: 24})]
    state = league_state(*log, players=many)
    assert f"{1024 if teams > 2 else 100:,} rated episodes" in ticker().line(state, "done", [], 200).split(" · ")
    more = replace(state, ladder=state.ladder.extended(log))
    assert more.ladder.payoff.valid_episodes == 2 * state.ladder.payoff.valid_episodes


def test_trials_of_one_team_are_rated_episodes():
    alone = [player("blue", 0)]
    state = league_state(match("blue@64", None, 60, 30, 10, voids=5), players=alone)
    assert "100 rated episodes" in ticker().line(state, "done", [], 200).split(" · ")
