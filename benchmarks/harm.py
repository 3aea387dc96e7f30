"""Harm that is done to a running league, each a function that tells in words what it did to whom."""

import os
import random
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from benchmarks.hunted import LEAGUE, LEASE, Hunted, Lost, findings, is_alive
from benchmarks.servers import Line, Server
from league.daemon import LEASE as LEADS
from storage.store import Store


@dataclass
class Scene:
    """A hunted league and what it stands on, as far as there is any."""

    hunted: Hunted
    dice: random.Random
    server: Server | None = None
    line: Line | None = None
    disk: Path | None = None  # where its blobs are, and its rows on SQLite, if that is a small one


def kill_one(scene: Scene) -> Counter[str]:
    """SIGKILL to one process, manager or worker."""
    pid, kind = scene.dice.choice(sorted(scene.hunted.processes().items()) or [(0, "")])
    return _killed({pid: kind})


def kill_all(scene: Scene) -> Counter[str]:
    """SIGKILL to all processes at once, in some order."""
    found = list(scene.hunted.processes().items())
    scene.dice.shuffle(found)
    return _killed(dict(found)) + Counter({"all at once": 1})


def kill_starting(scene: Scene) -> Counter[str]:
    """SIGKILL to all processes, and again and again while those come up that were started instead."""
    told = Counter[str]()
    for _ in range(scene.dice.randint(2, 5)):
        told += kill_all(scene)
        pause = time.monotonic() + scene.dice.uniform(0, 6)
        if not scene.hunted.wait(lambda until=pause: time.monotonic() > until, 60):
            break  # it has come to its end
    return told + kill_all(scene)


def freeze(scene: Scene) -> Counter[str]:
    """SIGSTOP to one process for longer than it may be silent, and then SIGCONT."""
    pid, kind = scene.dice.choice(sorted(scene.hunted.processes().items()) or [(0, "")])
    if not is_alive(pid):
        return Counter()
    os.kill(pid, signal.SIGSTOP)
    time.sleep(LEADS + 2 if kind == "manager" else 2 * LEASE)
    if is_alive(pid):
        os.kill(pid, signal.SIGCONT)
    return Counter({f"{kind} stopped beyond its lease": 1})


def second_manager(scene: Scene) -> Counter[str]:
    """Start another `league run` on the same store; whoever leads, the other must end."""
    other = scene.hunted.start()
    both = [each for each in (scene.hunted.process, other) if each is not None]
    deadline = time.monotonic() + 300
    while all(each.poll() is None for each in both):
        if time.monotonic() > deadline:
            raise Lost("two managers work side by side for five minutes")
        time.sleep(0.1)
    if other.poll() is None:
        scene.hunted.process = other
    return Counter({"second manager": 1})


def fill_disk(scene: Scene) -> Counter[str]:
    """Fill the small disk to the last byte, for a while."""
    assert scene.disk is not None
    ballast = scene.disk / "ballast"
    try:
        with ballast.open("wb", buffering=0) as file:
            while file.write(bytes(1 << 12)):
                pass
    except OSError:
        pass  # it is full
    time.sleep(scene.dice.uniform(1, 10))
    ballast.unlink()
    return Counter({"disk full": 1})


def restart_server(scene: Scene) -> Counter[str]:
    """Crash PostgreSQL, or have it cut all connections, and start it again after a while."""
    assert scene.server is not None
    how = scene.dice.choice(("immediate", "fast"))
    scene.server.stop(how)
    time.sleep(scene.dice.uniform(0, 5))
    scene.server.start()
    return Counter({f"PostgreSQL restarted ({how})": 1})


def cut_line(scene: Scene) -> Counter[str]:
    """Cut the network to the database, for longer than a lease or for a moment, in silence or not."""
    assert scene.line is not None
    silent = scene.dice.random() < 0.5
    scene.line.silence() if silent else scene.line.cut()
    time.sleep(scene.dice.uniform(0, 3 * LEASE))
    scene.line.cut()
    scene.line.mend()
    return Counter({f"network {'silent' if silent else 'cut'}": 1})


def skewed_worker(scene: Scene) -> Counter[str]:
    """Let a worker join whose clock is an hour before or behind that of all others."""
    skew = scene.dice.choice(("+1h", "-1h"))
    told = {"LD_PRELOAD": str(faketime()), "FAKETIME": skew, "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    joined = scene.hunted.start("worker", **told)
    scene.hunted.seen.add(joined.pid)

    def came(store: Store) -> bool:
        return any(worker.pid == joined.pid for worker in store.workers(LEAGUE, 7200))

    worked = scene.hunted.wait(lambda: joined.poll() is not None or scene.hunted.look(came), 180)
    return Counter({f"worker joined with its clock {skew}": 1} if worked and joined.poll() is None else {})


def faketime() -> Path | None:
    """The library that gives a process another clock; None where it is not installed."""
    return next(iter(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")), None)


def damage(scene: Scene) -> Counter[str]:
    """Truncate, flip a bit of, or remove a blob that a row names; verify finds that and no more; put it back.

    For a league that has ended: in one that runs, what is damaged may be named no more when it is looked at.
    """
    hunted, told = scene.hunted, Counter[str]()
    for what, harm in _DAMAGE.items():
        path = scene.dice.choice(_named(hunted))
        whole = path.read_bytes()
        changed = harm(whole, scene.dice)
        path.unlink()
        if changed is not None:
            path.write_bytes(changed)
        found = [each for each in findings(hunted) if each["kind"] != "orphaned"]
        path.write_bytes(whole)
        digest = path.parent.name + path.name
        if not found or any(digest not in each["place"] + each["problem"] for each in found):
            raise Lost(f"a blob was {what}, and league verify says {found}")
        told[f"blob {what}"] += 1
    return told


_DAMAGE: Mapping[str, Callable[[bytes, random.Random], bytes | None]] = {
    "truncated": lambda data, dice: data[: dice.randrange(len(data))],
    "with a bit flipped": lambda data, dice: _flipped(data, dice.randrange(8 * len(data))),
    "removed": lambda data, dice: None,
}


def _flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def _named(hunted: Hunted) -> list[Path]:
    """The blobs that rows name."""
    found = hunted.look(lambda s: [*s.snapshots(LEAGUE), *s.newest_checkpoints(LEAGUE).values()])
    return sorted({hunted.blobs / each.digest[:2] / each.digest[2:] for each in found})


def _killed(victims: Mapping[int, str]) -> Counter[str]:
    told = Counter[str]()
    for pid, kind in victims.items():
        if is_alive(pid):
            os.kill(pid, signal.SIGKILL)
            told[f"{kind} killed"] += 1
    return told
