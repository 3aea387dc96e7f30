"""Learning curves as runs of Weights & Biases, which hold each iteration once however often they are written.

W&B stores logged data in its own files, one folder per writing process. They are read back with W&B's own reader to
find out which iterations a player's run has, and the missing iterations are added. The files stay on this machine
unless WANDB_MODE says otherwise; `wandb sync` sends them later.
"""

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Literal

from dashboards.errors import ViewerError
from storage.records import CurvePoint

ITERATION = "iteration"
PATIENCE = 60.0  # s
PROJECT = "robot-league"  # unless WANDB_PROJECT names one


class WandbRun:
    """A player's run, open for writing. See `open_run`."""

    def __init__(self, folder: Path, league: str, player: str, id: str):
        self._folder, self._about, self._id = folder, (league, player), id
        self._run: Any = None
        self.iteration = max(_iterations(folder, self._id), default=0)  # the newest iteration in W&B's files

    def extend(self, points: Iterable[CurvePoint]) -> int:
        """Add the points that the run does not have; points come in iteration order. Return how many were added.

        Raises ViewerError where W&B rejects them.
        """
        new = [point for point in points if point.iteration > self.iteration]
        if new and self._run is None:
            self._run = _started_run(self._folder, self._id, *self._about)
        for point in new:
            about = {ITERATION: point.iteration, "environment_steps": point.step, "training_seconds": point.seconds}
            self._run.log({**about, **point.values}, step=point.iteration)
            self.iteration = point.iteration
        return len(new)

    def close(self) -> None:
        """Finish the run and wait until W&B's own process has written all data.

        Raises ViewerError where it does not.
        """
        if self._run is None:
            return
        self._run.finish()
        self._run, began = None, time.monotonic()
        while max(_iterations(self._folder, self._id), default=0) < self.iteration:
            if time.monotonic() - began > PATIENCE:
                raise ViewerError(f"Weights & Biases has not written all to {self._folder} within {PATIENCE:g} s")
            time.sleep(0.1)


@contextmanager
def open_run(folder: Path, league: str, player: str, created: float, identity: str) -> Iterator[WandbRun]:
    """Open a player's run in a folder, made if needed, for a league with that identity and creation time.

    Raises ViewerError where wandb is not installed, WANDB_MODE is neither offline nor online, the folder cannot be
    written, or another process writes the run.
    """
    wandb_mode()
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # no error reports to W&B
    try:
        import wandb  # noqa: F401
    except ImportError as error:
        need = f"runs of Weights & Biases need wandb ({error}); install it with: pip install 'robot-league[wandb]'"
        raise ViewerError(need) from error
    folder = folder.absolute()  # W&B would expand ~ to the home folder
    id = _id(folder, f"{league}/{player}/{created:.6f}", identity)
    with _locked_file(folder, f".{id}.lock"):
        run = WandbRun(folder, league, player, id)
        try:
            yield run
        finally:
            run.close()


def _id(folder: Path, about: str, identity: str) -> str:
    """Return a run's id: an earlier version's, without the league's identity, if the folder has such a run."""
    earlier, today = (hashlib.sha256(text.encode()).hexdigest()[:16] for text in (about, f"{about}/{identity}"))
    return earlier if any(folder.glob(f"wandb/*run-*-{earlier}")) else today


def _locked_file(folder: Path, name: str) -> IO[str]:
    """Lock a file in a folder, made if needed, until the file is closed. Raises ViewerError on failure."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / name).open("w")
    except OSError as error:
        raise ViewerError(f"{folder} cannot be written: {error.strerror}; give another folder") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise ViewerError(f"another league log writes {folder}: end that one, or give another folder") from error
    return file


def wandb_mode() -> Literal["offline", "online"]:
    """Return "online" if WANDB_MODE has runs sent, else "offline". Raises ViewerError for an unknown mode."""
    asked = os.environ.get("WANDB_MODE", "offline")
    if asked not in ("offline", "online"):
        raise ViewerError(f"WANDB_MODE is {asked!r}, by which nothing is kept: set it to offline or online")
    return "online" if asked == "online" else "offline"


def _started_run(folder: Path, id: str, league: str, player: str) -> Any:
    import wandb

    settings = wandb.Settings(
        console="off", silent=True, save_code=False, disable_git=True, x_disable_meta=True, x_disable_stats=True
    )
    more: dict[str, Any] = {"resume": "allow"} if wandb_mode() == "online" else {}
    _wait_for_next_second(folder, id)
    try:
        return wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT), dir=folder, id=id, name=f"{league}/{player}",
            group=league, mode=wandb_mode(), reinit="create_new", settings=settings, **more,
        )  # fmt: skip
    except (wandb.Error, OSError) as error:
        why = " ".join(str(error).split())
        raise ViewerError(
            f"Weights & Biases did not start a run: {why}; WANDB_MODE=offline needs no connection"
        ) from error


def _wait_for_next_second(folder: Path, id: str) -> None:
    """Wait until W&B, which names a run's folder by the second of its start, would make a new folder."""
    begun = [each.stat().st_ctime for each in folder.glob(f"wandb/*run-*-{id}")]
    time.sleep(min(max(1.0 - (time.time() - max(begun, default=0.0)), 0.0), 1.0))


def _iterations(folder: Path, id: str) -> Iterator[int]:
    """Yield the iterations of a run in W&B's files in a folder; a killed writer's partial record is left out."""
    for file in sorted(folder.glob(f"wandb/*run-*-{id}/run-{id}.wandb")):
        for record in records(file):
            for item in record.history.item:
                if ITERATION in (item.key, *item.nested_key):
                    yield int(json.loads(item.value_json))


def records(file: Path) -> Iterator[Any]:
    """Yield W&B's records in one of its files, up to the first damage, by its own reader."""
    from wandb.proto.wandb_internal_pb2 import Record  # pyright: ignore[reportAttributeAccessIssue]
    from wandb.sdk.internal.datastore import DataStore

    source = DataStore()
    try:
        source.open_for_scan(str(file))
        while (data := source.scan_data()) is not None:
            yield Record.FromString(data)
    except (AssertionError, OSError):  # its reader's errors for a partial record
        return
    finally:
        source.close()
