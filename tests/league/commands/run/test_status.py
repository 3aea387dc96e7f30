"""What `league status` says of a league that runs, stands still or has trouble."""

import os
import re
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import sqlalchemy as sa

from league.commands.run import status as module
from league.commands.run.status import report, status
from league.queries.league_status import gather_status
from league.queries.query import Open
from storage.database import health
from storage.records import CurvePoint, Job, League, Phase
from storage.store import Store
from tests.league.leagues import filled, finish, match

HERE = socket.gethostname()
ALIVE = f"{HERE}:{os.getpid()}:manager"


@pytest.fixture
def dead() -> int:
    """The id of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


@pytest.fixture
def opened(tmp_path):
    with filled(tmp_path / "store") as store:
        yield Open(store)


def words(opened, **given) -> str:
    return " ".join(report(opened, **given).split())


def doing(opened) -> dict[str, str]:
    return {player["player"]: player["now"] for player in gather_status(opened).players}


def test_a_transaction_that_another_client_holds_open_is_named(server_url, tmp_path, monkeypatch):
    monkeypatch.setattr(health, "OPEN_SECONDS", -1.0)
    other = sa.create_engine(sa.make_url(server_url).update_query_dict({"application_name": "nightly dump"}))
    with Store.open(server_url, create=True, blobs=tmp_path) as store, other.connect() as db:
        store.create_league(League("cup", ""))
        pid = db.scalar(sa.text("SELECT pg_backend_pid()"))
        text = report(Open(store))
    other.dispose()
    assert "Warning:\n  a transaction is open since 0 min (nightly dump, idle in transaction, " + f"pid {pid})" in text


def test_the_free_disk_is_told_where_only_the_blobs_are_in_a_folder(server_url, tmp_path):
    with Store.open(server_url, create=True, blobs=tmp_path) as store:
        store.create_league(League("cup", ""))
        assert re.search(r"Disk: [\d,.]+ GB free", report(Open(store)))


def test_the_fuller_disk_is_told_where_blobs_have_one_of_their_own(tmp_path, monkeypatch):
    kept = tmp_path / "kept"
    monkeypatch.setattr(shutil, "disk_usage", lambda at: SimpleNamespace(free=7e9 if Path(at) == kept else 9e9))
    with Store.open(tmp_path / "store", create=True, blobs=kept) as store:
        store.create_league(League("cup", ""))
        assert "Disk: 9.0 GB free" in report(Open(store))  # the first blob makes the folder
        store.blobs.put(b"policy")
        assert "Disk: 7.0 GB free" in report(Open(store))


def test_a_league_that_nobody_manages_is_stopped(opened):
    text = report(opened)
    assert text.startswith("League cup: stopped\n")
    assert doing(opened) == {"blue": "stopped", "red": "stopped"}


def test_work_that_a_killed_process_left_is_not_being_worked_on(opened):
    opened.store.queue([Job("cup", "train", "turn:9")])
    assert opened.store.claim("cup", ["train"], "w:1:1", 60) is not None
    assert "1 left by a process that is gone, done again by the next 'league run'" in words(opened)
    opened.store.acquire_leadership("cup", ALIVE, 60)
    assert "1 being worked on" in words(opened)


def test_a_stopped_league_without_such_work_says_nothing_of_it(opened):
    assert "gone" not in words(opened)
    assert "0 being worked on" in words(opened)


def test_a_league_is_stopped_once_its_managers_process_is_gone_or_its_lease_is_over(opened, dead):
    opened.store.acquire_leadership("cup", ALIVE, 60)
    assert words(opened).startswith(f"League cup: running, managed by {ALIVE}")
    opened.store.release_leadership("cup", ALIVE)
    opened.store.acquire_leadership("cup", f"{HERE}:{dead}:manager", 60)
    assert words(opened).startswith("League cup: stopped")
    opened.store.release_leadership("cup", f"{HERE}:{dead}:manager")
    opened.store.acquire_leadership("cup", "elsewhere:1:manager", 60)
    assert words(opened).startswith("League cup: running, managed by elsewhere:1:manager")
    opened.store.acquire_leadership("cup", "elsewhere:1:manager", -1)
    assert words(opened).startswith("League cup: stopped")


def test_it_tells_who_learns_since_when_and_what_ends_it(opened):
    leap = Phase("cup", "1", 3, ("red",), {"blue": 2, "red": 1}, {"iterations": 5})
    opened.store.queue([], [leap, Phase("cup", "2", 0, ("blue", "red"), {"blue": 0, "red": 0})])
    opened.store.queue([], [Phase("cup", "3", 0, ("red",), {"red": 1}, {"step": 1000})])
    opened.store.acquire_leadership("cup", ALIVE, 60)
    text = words(opened)
    # red has done 4 iterations, one of them before the phase.
    assert "group 1: red learns since iteration 1; it ends after 5 iterations, 2 are left" in text
    assert "group 2: blue and red learn since iteration 0; nothing ends it" in text
    assert "group 3: red learns since iteration 1; it ends at step 1,000, 600 are left" in text
    assert doing(opened) == {"blue": "rests", "red": "learns"}


def test_it_tells_which_score_ends_a_turn_and_how_far_that_is(opened):
    until = {"iterations": 5, "score": 0.7}
    opened.store.queue([], [Phase("cup", "1", 0, ("red",), {"blue": 2, "red": 1}, until)])
    asked = "it ends after 5 iterations, 2 are left, or before that when it surely scores above 70 %:"
    assert f"{asked} no episode has ended yet" in words(opened)
    points = [CurvePoint("cup", "red", i, 1, 1.0, {"episodes": 100.0, "score": i / 4}) for i in (1, 2, 3)]
    finish(opened.store, curves=points)
    assert f"{asked} it scores 62.5 % (55.6-68.9) of 200" in words(opened)  # since iteration 1
    finish(opened.store, curves=[CurvePoint("cup", "red", 4, 1, 1.0, {"episodes": 500.0, "score": 0.9})])
    assert "its turn is over, because it surely scores above 70 %: it scores 90.0 % (87.1-92.3) of 500" in words(opened)


def test_it_tells_what_rating_takes_of_training(opened):
    assert "Rating: 0 % of the time of the devices that train (rating.share: 10 %)" in words(opened)
    log = [match("blue@4", "blue@0", 3, 1, due=due, seconds=90.0) for due in (None, 400.0, 900.0)]
    finish(opened.store, matches=log)
    opened.store.set_config("cup", "[rating]\nshare = 0.05\n")
    # 180 s of the 4,000 that blue and red were trained for, less the 400 of which nobody noted what was rated.
    assert "Rating: 5 % of the time of the devices that train (rating.share: 5 %)" in words(opened)
    opened.store.set_config("cup", '[rating]\nshare = 1.0\n[training.schedule]\nkind = "leapfrog"\n')
    assert "Rating: 2.37 % of the time of the devices that train (rating.share: as much as they get)" in words(opened)


def test_paused_players_and_jobs_set_aside_tell_their_reasons(opened):
    store = opened.store
    store.set_paused("cup", "red", "policy loss is nan\nin iteration 7")
    store.queue([Job("cup", "match", "match:bad")])
    for _ in range(2):
        lease, _ = store.claim("cup", ["match"], "w:1:1", 60)
        store.fail(lease, "ValueError: blob ab12 is damaged\nTraceback: line 3", tries=2, wait=0)
    text = report(opened)
    assert "Paused:\n  red: policy loss is nan (--debug shows it all)" in text
    assert "Set aside:\n  match:bad, tried 2 times: ValueError: blob ab12 is damaged (--debug shows it all)" in text
    assert "1 set aside" in text
    assert "line 3" not in text
    assert "Traceback: line 3" in report(opened, whole_errors=True)
    assert doing(opened)["red"] == "paused"


def test_the_words_of_dead_workers_are_not_repeated(opened, dead):
    for pid, doing in ((os.getpid(), "training"), (dead, "compiling")):
        said = {"doing": doing, "learners": ["blue"], "iteration": 7, "steps_per_second": 1234.5}
        opened.store.heartbeat(f"{HERE}:{pid}:train0", "cup", "train", pid, HERE, said)
    text = words(opened)
    assert "training blue 7" in text
    assert "compiling" not in text
    assert "stopping, 1 worker still finishes" in text


def test_the_command_prints_it(opened, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(module.sys, "argv", ["league", "status"])
    assert status(["--store", str(tmp_path / "store")]) == 0
    assert capsys.readouterr().out.startswith("League cup: stopped")
