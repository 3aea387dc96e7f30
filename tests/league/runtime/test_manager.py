"""The manager alone: what it plans, without the worker processes that would do it."""

import multiprocessing
import signal
import threading
import time
from dataclasses import replace
from multiprocessing.synchronize import Event

from league.config import presets
from league.config.experiment import Budget
from league.config.run_spec import RunSpec
from league.runtime.bootstrap import create
from league.runtime.manager import Manager, _Slot
from league.state.jobs import RatingMatch
from storage.errors import Unavailable
from storage.records import Job
from storage.store import Store
from tests.league.leagues import filled, match


def test_a_plan_for_which_the_store_was_away_is_made_again(duel, tmp_path, capsys):
    config = presets.preset("duel")
    with Store.open(tmp_path / "store", create=True) as store:
        create(store, config, duel)
        manager = Manager(store, spec := RunSpec.of(str(tmp_path / "store"), config), spec.config())
        manager._slots.clear()
        queue, lost = store.queue, []

        def lose_one(*args):
            if not lost:
                lost.append(args)
                raise Unavailable("the store: another process kept it locked for 60 s")
            return queue(*args)

        store.queue = lose_one
        told = []

        def tell(state, *_):
            told.append([job.kind for job in state.jobs])
            if told[-1] or len(told) > 3:
                store.ask_stop(config.league)

        assert manager.run(tell) == "stopped"
        assert lost
        assert "train" in told[-1]
        assert "waiting: the store: another process" in capsys.readouterr().err
        assert store.leader(config.league) is None


def finish_when_asked_to_end(where: str, ready: Event) -> None:
    """A worker that is in the middle of a rating batch when it is asked to end, and finishes it."""
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: asked.set())
    ready.set()
    with Store.open(where) as store:
        claimed = None
        while claimed is None:
            claimed = store.claim("cup", [RatingMatch.kind], "elsewhere:1:match0", 60)
            asked.wait(0.02)
        asked.wait(60)
        store.finish(claimed[0], matches=[match("blue@4", "red@4", 256, 256)])


def test_what_is_told_at_the_end_has_the_batch_that_was_being_played_when_time_was_up(tmp_path):
    """A run with "done · 0 rated episodes" above a table of 512: the line was told before workers had ended."""
    where, told = tmp_path / "store", []
    config = replace(presets.preset("quickstart"), league="cup", budget=Budget(steps=1, rating_time="1s"))
    with filled(where, match("blue@1", "red@1", 64, 64)) as store:
        manager = Manager(store, RunSpec.of(str(where), config), config)
        context = multiprocessing.get_context("spawn")
        ready = context.Event()
        process = context.Process(target=finish_when_asked_to_end, args=(str(where), ready))
        process.start()
        assert ready.wait(60)
        manager._slots[:] = [_Slot((RatingMatch.kind,), 0, process)]
        assert manager.run(lambda state, stage, _: told.append((stage, state.ladder.payoff.home.sum()))) == "done"
    assert told[-2:] == [("ending", 64), ("done", 64 + 256)]
    assert {stage for stage, _ in told[:-2]} == {"rating"}


def play_after(where: str, seconds: float) -> None:
    """A worker that takes a rating batch and needs so long for it."""
    with Store.open(where) as store:
        claimed = None
        while claimed is None:
            claimed = store.claim("cup", [RatingMatch.kind], "elsewhere:1:match0", 60)
            time.sleep(0.02)
        time.sleep(seconds)
        store.finish(claimed[0], matches=[match("blue@4", "red@4", 256, 256)])


def test_the_first_match_of_a_league_is_waited_for_when_the_time_for_rating_is_over(tmp_path):
    where, told = tmp_path / "store", []
    config = replace(presets.preset("quickstart"), league="cup", budget=Budget(steps=1, rating_time="1s"))
    with filled(where) as store:
        manager = Manager(store, RunSpec.of(str(where), config), config)
        manager._slots.clear()
        worker = threading.Thread(target=play_after, args=(str(where), 3.0))
        worker.start()
        assert manager.run(lambda state, stage, _: told.append((stage, state.ladder.payoff.home.sum()))) == "done"
        worker.join()
    assert told[-1] == ("done", 256)


def test_a_first_match_that_no_process_of_this_run_plays_is_not_waited_for(tmp_path):
    config = replace(presets.preset("quickstart"), league="cup", budget=Budget(steps=1, rating_time="1s"))
    config = replace(config, workers=replace(config.workers, match=0))
    with filled(tmp_path / "store") as store:
        store.queue([Job("cup", RatingMatch.kind, "left by a run before")])
        manager = Manager(store, RunSpec.of(str(tmp_path / "store"), config), config)
        manager._slots.clear()
        assert manager.run(lambda *_: None) == "done"


def test_workers_have_time_for_an_iteration_that_takes_longer_than_a_minute(tmp_path):
    """A worker killed amid a turn loses all its iterations: one of 480 decisions took 30 s on two cores."""
    config = replace(presets.preset("quickstart"), league="cup")
    with filled(tmp_path / "store") as store:
        manager = Manager(store, RunSpec.of(str(tmp_path / "store"), config), config)
        assert manager._grace() == 60.0
        store.heartbeat("here:1:train0", "cup", "train", 1, "here", {"doing": "waiting"})
        assert manager._grace() == 60.0
        store.heartbeat("here:1:train0", "cup", "train", 1, "here", {"iteration_seconds": 5.0})
        assert manager._grace() == 60.0
        store.heartbeat("here:2:train1", "cup", "train", 2, "here", {"iteration_seconds": 120.0})
        assert manager._grace() == 360.0
