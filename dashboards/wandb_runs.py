"""Learning curves as runs of Weights & Biases, which hold each iteration once however often they are written.

W&B keeps what it is told in files of its own, a folder for each time that somebody writes. By them it is known what a
player's run has already: they are read back with W&B's own reader, and what they lack is added. They stay on this
machine unless WANDB_MODE says otherwise; `wandb sync` sends them later.
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
PROJECT = "robot-league"  # where WANDB_PROJECT names none


class Runs:
    """A player's run, open for writing. See `runs`."""

    def __init__(self, folder: Path, league: str, player: str, began: float):
        self._folder, self._about = folder, (league, player)
        self._id = hashlib.sha256(f"{league}/{player}/{began:.6f}".encode()).hexdigest()[:16]
        self._run: Any = None
        self.iteration = max(_iterations(folder, self._id), default=0)  # the newest that W&B's files hold

    def extend(self, points: Iterable[CurvePoint]) -> int:
        """Add those that it does not have, which must come in the order of iterations; how many these were.

        Raises ViewerError where W&B does not take them.
        """
        new = [point for point in points if point.iteration > self.iteration]
        if new and self._run is None:
            self._run = _begun(self._folder, self._id, *self._about)
        for point in new:
            about = {ITERATION: point.iteration, "environment_steps": point.step, "training_seconds": point.seconds}
            self._run.log({**about, **point.values}, step=point.iteration)
            self.iteration = point.iteration
        return len(new)

    def close(self) -> None:
        """Have W&B write what it still holds, by a process of its own, and wait until that has.

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
def runs(folder: Path, league: str, player: str, began: float) -> Iterator[Runs]:
    """A player's run in a folder, made if need be, of a league that was made at a time.

    Raises ViewerError where wandb is not installed, WANDB_MODE says neither offline nor online, the folder cannot be
    written, or somebody else writes the run.
    """
    mode()
    os.environ.setdefault("WANDB_ERROR_REPORTING", "false")  # or it would tell its makers of its own faults
    try:
        import wandb  # noqa: F401
    except ImportError as error:
        need = f"runs of Weights & Biases need wandb ({error}); install it with: pip install 'robot-league[wandb]'"
        raise ViewerError(need) from error
    with _held(folder, f".{league}.{player}.lock"):
        run = Runs(folder, league, player, began)
        try:
            yield run
        finally:
            run.close()


def _held(folder: Path, name: str) -> IO[str]:
    """A lock in a folder, made if need be, until the file is closed. Raises ViewerError where there can be none."""
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


def mode() -> Literal["offline", "online"]:
    """Whether runs stay on this machine or are sent, as WANDB_MODE says. Raises ViewerError for any other word."""
    asked = os.environ.get("WANDB_MODE", "offline")
    if asked not in ("offline", "online"):
        raise ViewerError(f"WANDB_MODE is {asked!r}, by which nothing is kept: set it to offline or online")
    return "online" if asked == "online" else "offline"


def _begun(folder: Path, id: str, league: str, player: str) -> Any:
    import wandb

    settings = wandb.Settings(
        console="off", silent=True, save_code=False, disable_git=True, x_disable_meta=True, x_disable_stats=True
    )
    more: dict[str, Any] = {"resume": "allow"} if mode() == "online" else {}
    _into_another_second(folder, id)
    try:
        return wandb.init(
            project=os.environ.get("WANDB_PROJECT", PROJECT), dir=folder, id=id, name=f"{league}/{player}",
            group=league, mode=mode(), reinit="create_new", settings=settings, **more,
        )  # fmt: skip
    except (wandb.Error, OSError) as error:
        why = " ".join(str(error).split())
        raise ViewerError(f"Weights & Biases did not begin a run: {why}; WANDB_MODE=offline needs nobody") from error


def _into_another_second(folder: Path, id: str) -> None:
    """Wait until W&B, which names a run's folder by the second in which it begins, would make another one."""
    begun = [each.stat().st_ctime for each in folder.glob(f"wandb/*run-*-{id}")]
    time.sleep(min(max(1.0 - (time.time() - max(begun, default=0.0)), 0.0), 1.0))


def _iterations(folder: Path, id: str) -> Iterator[int]:
    """Those of a run that W&B's files in a folder hold; what a killed writer left of a record is not among them."""
    for file in sorted(folder.glob(f"wandb/*run-*-{id}/run-{id}.wandb")):
        for record in records(file):
            for item in record.history.item:
                if ITERATION in (item.key, *item.nested_key):
                    yield int(json.loads(item.value_json))


def records(file: Path) -> Iterator[Any]:
    """W&B's records in a file of it, as far as it is whole, by its own reader."""
    from wandb.proto.wandb_internal_pb2 import Record  # pyright: ignore[reportAttributeAccessIssue]
    from wandb.sdk.internal.datastore import DataStore

    source = DataStore()
    try:
        source.open_for_scan(str(file))
        while (data := source.scan_data()) is not None:
            yield Record.FromString(data)
    except (AssertionError, OSError):  # as its reader calls a record that was cut short
        return
    finally:
        source.close()
