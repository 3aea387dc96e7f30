"""Whole leagues whose blobs are in a bucket, run by the real command while faults are injected."""

import os
import subprocess
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from typing import Any

from tests.faults.hunted import LEAGUE, ROOT, Hunted, Lost, environment, examine, findings, ok
from tests.storage.object_storage.proxy import Faults, Proxy

SECONDS = 4.0  # of each fault in turn
MORE = 3.0  # times as large a share of requests as in `operations`: a league asks its server seldom
SUMO = (
    "--arena.name", "sumo-1v1", "--league", LEAGUE, "--seed", "3", "--engine", "c", "--training.worlds", "32",
    "--training.rollout_length", "16", "--learner.architecture.hidden", "16", "--rating.worlds", "32",
    "--training.iterations_per_turn", "2", "--budget.rating_time", "10s", "--rating.trained", "false",
)  # fmt: skip


class BucketHunted(Hunted):
    """A league of rock, paper, scissors with its blobs in a bucket."""

    def __init__(self, folder: Path, bucket: str, steps: int, flags: tuple[str, ...] = ()):
        super().__init__(folder, str(folder / "store"), steps)
        self._bucket, self._flags = bucket, flags

    @property
    def blobs(self) -> str:  # type: ignore[override]
        """The location of its blobs."""
        return f"s3://{self._bucket}/{self.folder.name}"

    def start(self, command: str = "run", **also: str) -> subprocess.Popen[bytes]:
        """Start `league run`, with its own flags if it has some."""
        if not self._flags:
            return super().start(command, **also)
        call = self.command(command, *self._flags, "--budget.steps", str(self.steps))
        with self.log.open("ab") as out:
            return subprocess.Popen(
                call, stdout=out, stderr=out, env=environment() | also, start_new_session=True, cwd=ROOT
            )


def disturbed(hunted: BucketHunted, proxy: Proxy, faults: dict[str, Faults], seconds: float) -> None:
    """Run a league to its end while the faults change. Raises Lost if it does not end in time or ends badly."""
    turns = cycle([replace(fault, share=min(0.9, MORE * fault.share)) for fault in faults.values()])
    try:
        ended = False
        while not ended and seconds > 0:
            proxy.faults = next(turns)
            ended = not hunted.wait(lambda: False, SECONDS) and hunted.process is not None
            ended = ended and hunted.process.poll() == 0  # type: ignore[union-attr]
            seconds -= SECONDS
    finally:
        proxy.faults = Faults()
    if seconds <= 0:
        hunted.end()
        raise Lost(f"it has not ended: {hunted.log.read_text()[-1500:]}")
    hunted.finish(60)


def compared(hunted: BucketHunted, expected: dict[str, Any]) -> dict[str, int]:
    """Return the counts of a league that must equal an undisturbed one. Raises Lost."""
    return examine(hunted, expected)[1]


def verified(hunted: BucketHunted) -> dict[str, int]:
    """Return the counts of a league on a clock: every row must have its blob. Raises Lost."""
    if bad := [each for each in findings(hunted) if each["kind"] != "orphaned"]:
        raise Lost(f"league verify: {bad[:3]}")
    ok(hunted.call("ratings"))
    jobs: list = hunted.look(lambda store: store.jobs(LEAGUE))
    snapshots: int = hunted.look(lambda store: len(store.snapshots(LEAGUE)))
    matches: int = hunted.look(lambda store: len(store.matches(LEAGUE)))
    if bad := [job.key for job in jobs if job.state == "failed"]:
        raise Lost(f"jobs that failed: {bad}")
    vain = sum(job.attempt - 1 for job in jobs if job.state == "done")
    return {"jobs": len(jobs), "attempts in vain": vain, "matches": matches, "snapshots": snapshots}


def messages(hunted: BucketHunted) -> int:
    """Return how many lines say that the league waits. Raises Lost if a line holds a key."""
    lines = hunted.log.read_text().splitlines()
    if any(os.environ["AWS_SECRET_ACCESS_KEY"] in line for line in lines):
        raise Lost("a line of the league's output holds the secret key")
    return sum("waiting: " in line for line in lines)


Check = Callable[[BucketHunted], dict[str, int]]
