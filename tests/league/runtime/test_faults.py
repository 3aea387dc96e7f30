"""Nothing that one bad job can stop: faults put into a running league, and what the league does about them."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from league.commands.run.status import status
from league.system import exit_codes
from storage.store import Store
from tests.league.conftest import BODILESS, ENVIRONMENT, start, wait_for

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("copied_league")]


def blob(folder: Path, digest: str) -> Path:
    return folder / "league-data" / "blobs" / digest[:2] / digest[2:]


def test_a_damaged_snapshot_is_set_aside_with_its_reason_and_the_league_goes_on(tmp_path, capsys):
    with Store.open(tmp_path / "league-data") as store:
        bad = next(s for s in store.snapshots("tiny", "blue") if s.iteration == 1)
    path = blob(tmp_path, bad.digest)
    path.write_bytes(path.read_bytes()[:-7])

    def met(store: Store) -> set[str | None]:
        return {name for m in store.matches("tiny") for name in (m.a, m.b)}

    again = start("run", "--steps", "3000", "--budget.rating_time", "10m", "--workers.match", "1", cwd=tmp_path)
    # The others are rated all the same.
    wait_for(tmp_path, lambda store: store.jobs("tiny", "failed") and len(met(store)) > 6)
    again.send_signal(signal.SIGINT)
    assert again.wait(timeout=90) == 0
    with Store.open(tmp_path / "league-data") as store:
        assert bad.name not in met(store)
        failed = store.jobs("tiny", "failed")
    assert all("damaged" in str(job.error) for job in failed)
    assert status(["--store", str(tmp_path / "league-data")]) == 0
    assert "damaged" in capsys.readouterr().out


def test_of_two_managers_started_at_the_same_instant_exactly_one_runs(tmp_path):
    both = [start("run", *BODILESS, "--budget.steps", "400000", "--workers.match", "0", cwd=tmp_path) for _ in range(2)]
    wait_for(tmp_path, lambda store: any(p.poll() is not None for p in both))
    (loser,) = [p for p in both if p.poll() is not None]
    (winner,) = [p for p in both if p is not loser]
    assert loser.returncode == exit_codes.PASSING
    assert "is running already" in (tmp_path / "out.txt").read_text()
    time.sleep(1)
    assert winner.poll() is None
    winner.send_signal(signal.SIGINT)
    assert winner.wait(timeout=90) == 0


def test_a_worker_whose_manager_dies_while_it_still_imports_does_not_live_on(tmp_path):
    with Store.open(tmp_path / "league-data") as store:
        config = store.league("tiny").config
    script = (
        "import sys, os\n"
        "from league.config.run_spec import RunSpec\nfrom league.runtime.worker_process import WorkerSpec\n"
        "from league.runtime.worker_process import work\n"
        f"spec = RunSpec({str(tmp_path / 'league-data')!r}, None, sys.stdin.read())\n"
        "work(WorkerSpec(spec, ('train',), 0, 999999999))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], input=config, text=True, timeout=540, env=ENVIRONMENT, cwd=tmp_path,
        capture_output=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with Store.open(tmp_path / "league-data") as store:
        assert not store.workers("tiny", 60)
