"""`league log`: files that TensorBoard and Weights & Biases read, each iteration once after any end."""

import json
import signal
import sys
import time
from pathlib import Path

import pytest

from dashboards.export.wandb import records
from league.commands.cli import main
from league.commands.watch.log import log
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


def logged(folder, player: str) -> list[dict[str, float]]:
    """Figures of each iteration, as W&B's own reader finds them in its files, the oldest file first."""
    rows = []
    for file in sorted((folder / "wb").glob("wandb/offline-run-*/run-*.wandb")):
        found = list(records(file))
        if any(record.run.display_name == f"cup/{player}" for record in found):
            items = [record.history.item for record in found if record.HasField("history")]
            rows += [{(i.key or i.nested_key[0]): json.loads(i.value_json) for i in each} for each in items]
    return [{name: row[name] for name in ("_step", "environment_steps", "score", "reward")} for row in rows]


def figures(*iterations: int) -> list[dict[str, float]]:
    told = ((i, p.step, p.values) for i, p in zip(iterations, points("blue", *iterations), strict=True))
    return [{"_step": i, "environment_steps": step, **values} for i, step, values in told]


def test_runs_of_wandb_hold_each_iteration_once_and_stay_on_this_machine(folder, capsys, monkeypatch):
    monkeypatch.delenv("WANDB_MODE", raising=False)

    def run() -> str:
        assert log(["--store", str(folder / "league-data"), "--wandb", str(folder / "wb")]) == 0
        return capsys.readouterr().out

    assert "blue: 3 iterations, up to 3\nred: 2 iterations, up to 2\n" in run()
    assert logged(folder, "blue") == figures(1, 2, 3)
    before = sorted((folder / "wb").glob("wandb/offline-run-*"))
    assert "iterations" not in run()
    assert sorted((folder / "wb").glob("wandb/offline-run-*")) == before
    learn(folder, *points("blue", 4))
    assert "blue: 1 iterations, up to 4\n" in run()
    assert logged(folder, "blue") == figures(1, 2, 3, 4)
    assert logged(folder, "red") == figures(1, 2)

    ids = {file.stem for file in (folder / "wb").glob("wandb/offline-run-*/run-*.wandb")}
    assert len(ids) == 2  # a run for each player, in several files
    (newest,) = [each for each in (folder / "wb").glob("wandb/offline-run-*") if each not in before]
    (file,) = newest.glob("run-*.wandb")
    file.write_bytes(file.read_bytes()[:300])  # killed before its history was whole
    assert [record.WhichOneof("record_type") for record in records(file)].count("history") == 0
    assert "blue: 1 iterations, up to 4\n" in run()


def test_without_wandb_the_extra_is_named(folder, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(SystemExit, match="2"):
        main(["log", "--store", str(folder / "league-data"), "--wandb", str(folder / "wb")])
    told = capsys.readouterr()
    assert (told.out, told.err.count("\n")) == ("", 1)
    assert "pip install 'robot-league[wandb]'" in told.err
    assert not (folder / "wb").exists()


@pytest.mark.parametrize(
    ("mode", "said"),
    [
        ("disabled", "WANDB_MODE is 'disabled', by which nothing is kept: set it to offline or online"),
        ("online", "and sent it."),
        ("offline", "wandb sync"),
    ],
)
def test_what_becomes_of_runs_is_told_by_the_word_that_wandb_goes_by(mode, said, tmp_path, capsys, monkeypatch):
    """In a league without a curve, so that nobody would be sent anything."""
    monkeypatch.setenv("WANDB_MODE", mode)
    filled(tmp_path / "store").close()
    with pytest.raises(SystemExit) as ended:
        main(["log", "--store", str(tmp_path / "store"), "--wandb", str(tmp_path / "wb")])
    told = capsys.readouterr()
    refused = mode == "disabled"
    assert ended.value.code == (2 if refused else 0)
    assert said in (told.err if refused else told.out)


def test_bad_input_is_one_line(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    (folder / "file").write_text("mine")
    for args, why in (
        ((), "needs --tensorboard FOLDER or --wandb FOLDER"),
        (("--tensorboard", "file"), "file cannot be written"),
        (("--wandb", "file"), "file cannot be written"),
        (("--wandb", "/proc/none"), "/proc/none cannot be written: No such file"),
    ):
        with pytest.raises(SystemExit, match="2"):
            main(["log", *args])
        told = capsys.readouterr()
        assert (told.out, told.err.count("\n")) == ("", 1)
        assert why in told.err
    assert (folder / "file").read_text() == "mine"


def test_two_leagues_of_one_name_in_two_stores_have_run_folders_of_their_own(folder, capsys):
    with filled(folder / "other") as store:
        finish(store, curves=points("blue", 1, 2, 3, 4, 5))

    def write(store: str) -> str:
        assert log(["--store", str(folder / store), "--tensorboard", str(folder / "tb")]) == 0
        return capsys.readouterr().out

    for _ in range(2):
        assert "another league" not in write("league-data")
        (own,) = {line.split(" has its runs")[0] for line in write("other").splitlines() if "another league" in line}
    found = {path.parent.parent.name: path for path in sorted((folder / "tb").glob("*/blue/*"))}
    assert found.keys() == {"cup", Path(own).name}
    assert [step for step, *_ in scalars(folder, "blue")] == [100, 200, 300]
    assert found[Path(own).name].stat().st_size > found["cup"].stat().st_size


def test_a_run_folder_of_an_earlier_version_is_gone_on_with(folder, written):
    written()
    today = file_of(folder, "blue")
    began = today.name.split(".")[3]
    earlier = today.with_name(f"events.out.tfevents.{began}.robot-league")
    today.rename(earlier)
    learn(folder, *points("blue", 4))
    assert "blue: 1 iterations, up to 4\n" in written()
    assert file_of(folder, "blue") == earlier


def test_a_folder_named_as_a_shell_names_the_home_folder_is_one_of_that_name(folder, capsys, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.chdir(folder)
    monkeypatch.setattr("dashboards.export.wandb.PATIENCE", 5.0)
    assert log(["--wandb", "~"]) == 0
    assert "Wrote ~" in capsys.readouterr().out
    assert list((folder / "~").glob("wandb/offline-run-*/run-*.wandb"))


def test_two_leagues_of_one_name_are_two_runs_of_wandb(folder, capsys):
    pytest.importorskip("wandb")
    with filled(folder / "other") as store:
        finish(store, curves=points("blue", 1, 2))
    for store in ("league-data", "other"):
        assert log(["--store", str(folder / store), "--wandb", str(folder / "wb")]) == 0
    ids = {path.name.rpartition("-")[2] for path in (folder / "wb" / "wandb").glob("offline-run-*")}
    assert len(ids) == 3  # blue and red of one, blue of the other
