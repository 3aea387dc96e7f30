"""`league log`: event files that TensorBoard reads, whole and single after any end."""

import signal
import time
from pathlib import Path

import pytest

from league.cli import main
from league.commands.log import log
from storage.records import CurvePoint
from storage.store import Store
from tests.league.conftest import call, start
from tests.league.leagues import filled, finish

pytest.importorskip("tensorboard")


def points(name: str, *iterations: int) -> list[CurvePoint]:
    return [CurvePoint("cup", name, i, 100 * i, float(i), {"score": i / 8, "reward": -i / 4}) for i in iterations]


@pytest.fixture
def folder(tmp_path):
    with filled(tmp_path / "league-data") as store:
        finish(store, curves=points("blue", 1, 2, 3) + points("red", 1, 2))
    return tmp_path


def learn(folder, *new: CurvePoint) -> None:
    with Store.open(folder / "league-data") as store:
        finish(store, curves=new)


def file_of(folder, player: str) -> Path:
    (found,) = (folder / "tb" / "cup" / player).iterdir()
    return found


def scalars(folder, player: str) -> list[tuple[int, float, float]]:
    """Steps, score and reward, as TensorBoard reads the file."""
    from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader

    events = list(LegacyEventFileLoader(str(file_of(folder, player))).Load())
    assert events[0].file_version == "brain.Event:2"
    told = [(event.step, {v.tag: v.simple_value for v in event.summary.value}) for event in events[1:]]
    return [(step, values["score"], values["reward"]) for step, values in told]


@pytest.fixture
def written(folder, capsys):
    """Write what is new, and give what the command says."""

    def run() -> str:
        assert log(["--store", str(folder / "league-data"), "--tensorboard", str(folder / "tb")]) == 0
        return capsys.readouterr().out

    return run


def test_a_curve_is_written_once_and_goes_on(folder, written):
    assert "blue: 3 iterations, up to 3\nred: 2 iterations, up to 2\n" in written()
    assert scalars(folder, "blue") == [(100, 1 / 8, -1 / 4), (200, 2 / 8, -2 / 4), (300, 3 / 8, -3 / 4)]
    before = file_of(folder, "blue").read_bytes()
    assert "iterations" not in written()
    assert file_of(folder, "blue").read_bytes() == before
    learn(folder, *points("blue", 4))
    assert "blue: 1 iterations, up to 4\n" in written()
    assert file_of(folder, "blue").read_bytes().startswith(before)
    assert [step for step, *_ in scalars(folder, "blue")] == [100, 200, 300, 400]


def test_a_writer_that_was_killed_in_an_event_is_gone_on_from(folder, written):
    written()
    file = file_of(folder, "blue")
    whole = file.read_bytes()
    for size in (len(whole) - 1, len(whole) - 60, 5, 0):
        file.write_bytes(whole[:size])
        written()
        assert file.read_bytes() == whole


def test_it_follows_a_league_until_it_is_ended_and_nobody_writes_beside_it(folder):
    process = start("log", "--tensorboard", "tb", "--follow", cwd=folder)
    try:
        said(folder, process, "Wrote tb")
        learn(folder, *points("red", 3))
        said(folder, process, "red: 1 iterations, up to 3")
        beside = call("log", "--tensorboard", "tb", cwd=folder)
        assert (beside.returncode, beside.stdout) == (2, "")
        assert "another league log writes" in beside.stderr
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait()
    assert [step for step, *_ in scalars(folder, "red")] == [100, 200, 300]


def said(folder, process, text: str) -> None:
    deadline = time.monotonic() + 60
    while text not in (folder / "out.txt").read_text():
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_bad_input_is_one_line(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    (folder / "file").write_text("mine")
    for args, why in (((), "needs --tensorboard FOLDER"), (("--tensorboard", "file"), "Not a directory")):
        with pytest.raises(SystemExit, match="2"):
            main(["log", *args])
        told = capsys.readouterr()
        assert (told.out, told.err.count("\n")) == ("", 1)
        assert why in told.err
    assert (folder / "file").read_text() == "mine"
