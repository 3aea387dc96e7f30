"""Faults injected into a running league; each function returns counts of what it did, by description."""

import os
import random
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from league.runtime.manager import LEASE as LEADS
from league.system import exit_codes
from storage.records import TIMELINE
from storage.store import Store
from tests.faults.hunted import LEAGUE, LEASE, ROOT, Hunted, Lost, findings, is_alive
from tests.faults.servers import Bouncer, Line, Pair, Server


@dataclass
class Scene:
    """A league under fault injection and its infrastructure, if any."""

    hunted: Hunted
    rng: random.Random
    server: Server | None = None
    line: Line | None = None
    disk: Path | None = None  # the small disk with its blobs, and on SQLite its rows
    pair: Pair | None = None  # its server and a standby
    pool: Bouncer | None = None  # before its server


def kill_one(scene: Scene) -> Counter[str]:
    """Send SIGKILL to one process, manager or worker."""
    pid, kind = scene.rng.choice(sorted(scene.hunted.processes().items()) or [(0, "")])
    return _killed({pid: kind})


def kill_all(scene: Scene) -> Counter[str]:
    """Send SIGKILL to all processes at once, in random order."""
    found = list(scene.hunted.processes().items())
    scene.rng.shuffle(found)
    return _killed(dict(found)) + Counter({"all at once": 1})


def kill_starting(scene: Scene) -> Counter[str]:
    """Send SIGKILL to all processes, and repeatedly to their replacements while they start."""
    counts = Counter[str]()
    for _ in range(scene.rng.randint(2, 5)):
        counts += kill_all(scene)
        pause = time.monotonic() + scene.rng.uniform(0, 6)
        if not scene.hunted.wait(lambda until=pause: time.monotonic() > until, 60):
            break  # it has ended
    return counts + kill_all(scene)


def freeze(scene: Scene) -> Counter[str]:
    """Send SIGSTOP to one process for longer than its lease, and then SIGCONT."""
    pid, kind = scene.rng.choice(sorted(scene.hunted.processes().items()) or [(0, "")])
    if not is_alive(pid):
        return Counter()
    os.kill(pid, signal.SIGSTOP)
    time.sleep(LEADS + 2 if kind == "manager" else 2 * LEASE)
    if is_alive(pid):
        os.kill(pid, signal.SIGCONT)
    return Counter({f"{kind} stopped beyond its lease": 1})


def second_manager(scene: Scene) -> Counter[str]:
    """Start another `league run` on the same store; one of the two must end."""
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
    """Fill the small disk completely for a while."""
    assert scene.disk is not None
    ballast = scene.disk / "ballast"
    try:
        with ballast.open("wb", buffering=0) as file:
            while file.write(bytes(1 << 12)):
                pass
    except OSError:
        pass  # it is full
    time.sleep(scene.rng.uniform(1, 10))
    ballast.unlink()
    return Counter({"disk full": 1})


def restart_server(scene: Scene) -> Counter[str]:
    """Crash PostgreSQL, or let it close all connections, and start it again after a while."""
    assert scene.server is not None
    how = scene.rng.choice(("immediate", "fast"))
    scene.server.stop(how)
    time.sleep(scene.rng.uniform(0, 5))
    scene.server.start()
    return Counter({f"PostgreSQL restarted ({how})": 1})


def cut_line(scene: Scene) -> Counter[str]:
    """Interrupt the network to the database, silently or not, for up to three leases."""
    assert scene.line is not None
    silent = scene.rng.random() < 0.5
    scene.line.silence() if silent else scene.line.cut()
    time.sleep(scene.rng.uniform(0, 3 * LEASE))
    scene.line.cut()
    scene.line.mend()
    return Counter({f"network {'silent' if silent else 'cut'}": 1})


def fail_over(scene: Scene) -> Counter[str]:
    """Crash the primary and promote its standby, which has heard nothing for some seconds."""
    assert scene.pair is not None
    scene.pair.fall_behind(scene.rng.uniform(0, 4))
    before = scene.hunted.revision()
    scene.pair.fail_over()
    if scene.pool is not None:
        scene.pool.reload(scene.pair.primary.port)
    scene.hunted.direct = scene.pair.primary.url(LEAGUE)
    lost = before % TIMELINE - scene.hunted.revision() % TIMELINE  # what has been done again since then is not counted
    return Counter({"failover": 1, "changes that the standby lacked": max(0, lost)})


def skewed_worker(scene: Scene) -> Counter[str]:
    """Let a worker join whose clock is an hour ahead or behind."""
    skew = scene.rng.choice(("+1h", "-1h"))
    variables = {"LD_PRELOAD": str(faketime()), "FAKETIME": skew, "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
    joined = scene.hunted.start("worker", **variables)
    scene.hunted.seen.add(joined.pid)

    def came(store: Store) -> bool:
        return any(worker.pid == joined.pid for worker in store.workers(LEAGUE, 7200))

    worked = scene.hunted.wait(lambda: joined.poll() is not None or scene.hunted.look(came), 180)
    return Counter({f"worker joined with its clock {skew}": 1} if worked and joined.poll() is None else {})


def unmount(scene: Scene) -> Counter[str]:
    """Move the folder of blobs away for a while; sometimes leave an empty one, as an unmounted disk does."""
    blobs, away = scene.hunted.blobs, scene.hunted.blobs.with_name("unmounted")
    if not any(blobs.glob("store-*")):
        return Counter()  # the league has not begun
    blobs.rename(away)
    if empty := scene.rng.random() < 0.5:
        blobs.mkdir()
    time.sleep(scene.rng.uniform(1, 10))
    if empty:
        below = [path for path in blobs.rglob("*") if path.is_file()]
        shutil.rmtree(blobs)  # writes that were under way were refused and are repeated
        if len(below) > len(scene.hunted.processes()):
            raise Lost(f"{len(below)} blobs were written below the mount point")
    elif blobs.exists():
        raise Lost("the folder of blobs was created again")
    away.rename(blobs)
    return Counter({f"blobs unmounted, {'an empty folder' if empty else 'nothing'} in their place": 1})


def broken_worker(scene: Scene) -> Counter[str]:
    """Let a worker join whose `import mujoco` fails: it must end by itself and fail no job."""
    broken = scene.hunted.folder.parent / "broken"
    broken.mkdir(exist_ok=True)
    (broken / "mujoco.py").write_text("raise ImportError('libGL.so.1: cannot open shared object file')\n")
    joined = scene.hunted.start("worker", PYTHONPATH=f"{broken}{os.pathsep}{ROOT}")
    scene.hunted.seen.add(joined.pid)
    if not scene.hunted.wait(lambda: joined.poll() is not None, 180):
        return Counter()
    failed = scene.hunted.look(lambda store: [job.error for job in store.jobs(LEAGUE, "failed")])
    if failed:
        raise Lost(f"a worker whose imports fail made {len(failed)} jobs fail: {str(failed[0])[:200]}")
    return Counter({"broken workers that stopped": int(joined.returncode == exit_codes.UNFIT)})


def faketime() -> Path | None:
    """Return the library that gives a process another clock; None if it is not installed."""
    return next(iter(Path("/usr/lib").glob("*/faketime/libfaketimeMT.so.1")), None)


def damage(scene: Scene) -> Counter[str]:
    """Truncate a blob that a row names, flip a bit of one, and remove one; `league verify` must find exactly that.

    The blob is restored each time. Only for an ended league: in a running one, the row may disappear meanwhile.
    """
    hunted, counts = scene.hunted, Counter[str]()
    for what, harm in _DAMAGE.items():
        path = scene.rng.choice(_named(hunted))
        whole = path.read_bytes()
        changed = harm(whole, scene.rng)
        path.unlink()
        if changed is not None:
            path.write_bytes(changed)
        found = [each for each in findings(hunted) if each["kind"] != "orphaned"]
        path.write_bytes(whole)
        digest = path.parent.name + path.name
        if not found or any(digest not in each["place"] + each["problem"] for each in found):
            raise Lost(f"a blob was {what}, and league verify says {found}")
        counts[f"blob {what}"] += 1
    return counts


_DAMAGE: Mapping[str, Callable[[bytes, random.Random], bytes | None]] = {
    "truncated": lambda data, rng: data[: rng.randrange(len(data))],
    "with a bit flipped": lambda data, rng: _flipped(data, rng.randrange(8 * len(data))),
    "removed": lambda data, rng: None,
}


def _flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def _named(hunted: Hunted) -> list[Path]:
    """Return the files of blobs that rows name."""
    found = hunted.look(lambda s: [*s.snapshots(LEAGUE), *s.newest_checkpoints(LEAGUE).values()])
    return sorted({hunted.blobs / each.digest[:2] / each.digest[2:] for each in found})


def _killed(victims: Mapping[int, str]) -> Counter[str]:
    counts = Counter[str]()
    for pid, kind in victims.items():
        if is_alive(pid):
            os.kill(pid, signal.SIGKILL)
            counts[f"{kind} killed"] += 1
    return counts
