"""A short campaign of faults, by the command of the long one: nothing is lost, doubled or changed."""

import json
import random
import tempfile
from pathlib import Path

import pytest

from storage.store import Store
from tests.faults import harm
from tests.faults.faults import add, loaded, main, possible, undisturbed, written
from tests.faults.harm import Scene
from tests.faults.hunted import LEAGUE, Hunted, Lost, findings
from tests.faults.servers import Line, Server, programs
from tests.storage.sound import fill

STEPS = 3072


def campaign(folder: Path, *args: str, expected: dict | None = None) -> dict:
    out = folder / "counts.json"
    assert main(["--out", str(out), "--no-disk", *args], expected) == 0, out.read_text()
    return json.loads(out.read_text())


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> dict:
    """The result of a league of as many steps without faults."""
    return undisturbed(tmp_path_factory.mktemp("undisturbed"), STEPS)


@pytest.mark.slow  # a minute or two of two cores
def test_processes_killed_at_random_moments_cost_nothing(expected, tmp_path):
    rounds = ("--rounds", "1", "--strikes", "4", "--steps", str(STEPS), "--databases", "sqlite")
    counts = campaign(tmp_path, *rounds, "--harm", "kill_one", "kill_all", expected=expected)
    assert counts["lost"] == []
    assert counts["databases"]["sqlite"]["rounds"] == 1
    assert counts["databases"]["sqlite"]["matches"] > 10
    assert counts["processes killed"] > 3


@pytest.mark.slow  # the same
def test_neither_do_blobs_that_are_unmounted_nor_a_worker_whose_imports_fail(tmp_path):
    rounds = ("--rounds", "1", "--strikes", "4", "--steps", "6144", "--databases", "sqlite")
    counts = campaign(tmp_path, *rounds, "--harm", "unmount", "broken_worker", "--seed", "2")
    assert counts["lost"] == []
    assert sum(counts["databases"]["sqlite"]["harm"].values()) > 1


@pytest.mark.slow  # the same
@pytest.mark.skipif(programs() is None, reason="no PostgreSQL is installed here")
def test_neither_does_a_database_that_crashes_or_cannot_be_reached(expected, tmp_path):
    rounds = ("--rounds", "1", "--strikes", "4", "--steps", str(STEPS), "--databases", "postgresql")
    counts = campaign(tmp_path, *rounds, "--harm", "restart_server", "cut_line", expected=expected)
    assert counts["lost"] == []
    assert sum(counts["databases"]["postgresql"]["harm"].values()) > 2


def test_counts_add_up_over_runs(tmp_path):
    out = tmp_path / "counts.json"
    for killed in (3, 4):
        figures = loaded(out)
        add(figures, "sqlite", {"harm": {"train killed": killed, "disk full": 1}, "jobs": 10})
        add(figures, "postgresql", {"harm": {"manager killed": 1}, "jobs": 1})
        written(figures, out)
    figures = loaded(out)
    assert figures["processes killed"] == 9
    assert figures["databases"]["sqlite"] == {"rounds": 2, "harm": {"disk full": 2, "train killed": 7}, "jobs": 20}


@pytest.fixture
def scene(tmp_path):
    """A league that does not run, with rows in every table."""
    with Store.open(tmp_path, create=True, blobs=tmp_path / "blobs") as store:
        fill(store)
    return Scene(Hunted(tmp_path, str(tmp_path), 0), random.Random(0))


def test_a_damaged_blob_is_found_and_nothing_else_is(scene, monkeypatch):
    monkeypatch.setattr(harm, "LEAGUE", "cup")
    assert set(harm.damage(scene)) == {"blob truncated", "blob with a bit flipped", "blob removed"}
    assert findings(scene.hunted) == []
    monkeypatch.setitem(harm._DAMAGE, "left as it is", lambda data, rng: data)
    with pytest.raises(Lost, match="a blob was left as it is, and league verify says"):
        harm.damage(scene)


def test_only_what_there_is_is_harmed(scene):
    assert LEAGUE != "cup"
    assert {do.__name__ for do in possible(scene, [])} == {
        "kill_one", "kill_all", "kill_starting", "freeze", "second_manager", "unmount", "broken_worker",
    }  # fmt: skip
    assert [do.__name__ for do in possible(scene, ["kill_all"])] == ["kill_all"]
    assert harm.kill_all(scene).total() == 1  # there is no process to kill, which counts as none


@pytest.mark.skipif(programs() is None, reason="no PostgreSQL is installed here")
@pytest.mark.slow  # a server is made
def test_a_line_hands_on_goes_silent_and_hangs_up(tmp_path):
    import psycopg

    for above in (tmp_path, *tmp_path.parents):  # the server's owner has to get through
        if above == Path(tempfile.gettempdir()).resolve():
            break
        above.chmod(0o755)
    server = Server(tmp_path / "server")
    line = Line(server.port)
    try:
        with psycopg.connect(server.url("league", line.port)) as through:
            assert through.execute("SELECT 41 + 1").fetchone() == (42,)
            line.silence()
            through.execute("SELECT 1") if line.process.poll() is not None else line.cut()
            with pytest.raises(psycopg.OperationalError):
                through.execute("SELECT 1")
        line.mend()
        server.stop()
        server.start()
        with psycopg.connect(server.url("league", line.port)) as again:
            assert again.execute("SELECT 1").fetchone() == (1,)
    finally:
        line.cut()
        server.stop()
