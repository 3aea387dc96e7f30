"""Exit codes: bad input is for a person to mend (2), trouble that may pass (75) for whoever starts it again."""

import multiprocessing
import signal
import socket
import sys
import threading
import time
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from league.commands import cli
from league.commands.run import join as command
from league.config import experiment as configuration
from league.config.run_spec import RunSpec
from league.runtime.manager import MAX_RESTARTS, Manager, ManagerError
from league.runtime.preflight import prepare
from league.system import exit_codes
from storage.errors import StorageError, Unavailable
from storage.records import League
from storage.store import Store

CONFIG = configuration.default("rock-paper-scissors")
ALONE = replace(CONFIG, league="cup", workers=replace(CONFIG.workers, train=1, match=0))
SPAWN = multiprocessing.get_context("spawn")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def nobody() -> str:
    """A server's URL at which nobody answers."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    return f"postgresql://league@127.0.0.1:{port}/league"


@pytest.mark.parametrize(
    "args",
    [
        ("run", "--arena.name", "rock-paper-scissors"), ("run", "--detach"), ("worker",), ("status",), ("ratings",),
        ("verify",), ("thin", "--alone"), ("migrate",), ("stop",), ("unpack", "cup.zip"),
    ],
)  # fmt: skip
def test_a_server_that_does_not_answer_is_trouble_that_may_pass(args, nobody, packed, folder, capsys):
    with pytest.raises(SystemExit) as left:
        cli.main([*args, "--store", nobody, "--blobs", "blobs"])
    assert left.value.code == exit_codes.PASSING, capsys.readouterr().err


@pytest.mark.parametrize("what", ["no store", "no folder to make one in", "no permission to be asked for"])
def test_what_a_person_is_to_mend_is_bad_input(what, folder, capsys):
    (folder / "file").write_text("")
    where = {"no store": "none", "no folder to make one in": "file/store"}.get(what, "mysql://league@host/league")
    with pytest.raises(SystemExit) as left:
        cli.main(["run" if what == "no folder to make one in" else "status", "--store", where])
    assert left.value.code == exit_codes.BAD_INPUT


def test_who_prepares_a_league_tells_that_the_store_is_away(nobody, folder):
    config = replace(CONFIG, storage=replace(CONFIG.storage, blobs="blobs"))
    with pytest.raises(Unavailable, match="wait and try again") as told:
        prepare(RunSpec.of(nobody, config), config)
    assert str(told.value).count("wait and try again") == 1


def ended(code: int) -> BaseProcess:
    process = SPAWN.Process(target=sys.exit, args=(code,))
    process.start()
    process.join()
    return process


@pytest.fixture
def manager(folder):
    with Store.open(folder / "store", create=True) as store:
        store.create_league(League("cup", ""))
        yield Manager(store, RunSpec.of(str(folder / "store"), ALONE), ALONE)


def test_a_worker_that_cannot_do_its_jobs_rests_and_its_end_is_no_death(manager):
    (slot,) = manager._slots
    for _ in range(9):
        slot.process, slot.started = ended(exit_codes.UNFIT), time.monotonic()
        manager._refill_slots()
        assert slot.process is None
    assert slot.deaths == 0
    assert slot.rests_until > time.monotonic() + 60


@pytest.mark.parametrize(("code", "passing"), [(exit_codes.BAD_INPUT, False), (exit_codes.PASSING, True)])
def test_a_manager_whose_workers_die_says_whether_that_may_pass(manager, code, passing):
    (slot,) = manager._slots
    slot.process, slot.started, slot.deaths = ended(code), time.monotonic(), MAX_RESTARTS
    with pytest.raises(ManagerError, match="died 6 times in a row") as told:
        manager._handle_exit(slot)
    assert told.value.transient is passing


def test_a_worker_that_waits_begins_as_soon_as_there_are_a_store_a_league_and_a_manager(folder, monkeypatch, capfd):
    monkeypatch.setattr(command, "LOOK", 0.01)
    options = command.WorkerOptions(store="store", wait=True)
    found = []
    waiting = threading.Thread(target=lambda: found.append(command._sought(options)))
    waiting.start()
    time.sleep(0.05)
    with Store.open("store", create=True) as store:
        time.sleep(0.05)
        store.create_league(League("cup", "seed = 1"))
        time.sleep(0.05)
        assert waiting.is_alive()
        assert store.acquire_leadership("cup", "elsewhere:1:manager", 60.0)
        waiting.join(timeout=30)
    assert found == [("cup", "elsewhere:1:manager", "seed = 1")]
    assert "league: waiting: No league store at" in capfd.readouterr().err
    with pytest.raises(StorageError):
        command._sought(command.WorkerOptions(store="none"))


def test_an_interrupt_is_neither(capsys):
    def interrupted() -> int:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job begins without it
        signal.raise_signal(signal.SIGINT)
        return 0

    assert cli.guarded(interrupted) == 130
