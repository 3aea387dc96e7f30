"""A league as services of a real systemd: killed, stopped, refused, its store away, its machine without power.

    python -m tests.faults.supervisors.systemd --out tests/faults/results/systemd-cpu.json
    python -m tests.faults.supervisors.systemd --cases killed rebooted

Each case makes a machine of namespaces (`container`; Debian's `debootstrap` and `systemd-container`, as root), installs
the wheel of this checkout and the units of `deploy/` there as docs/deploy.md tells, and runs a league of rovers on the
C engine to its end: all scheduled matches must be in the log once and nothing else, and parameters, curves, log and
ratings must equal those of an undisturbed league of the same seed. Exit code 1 if anything was lost, 2 where such a
machine cannot be had: nothing of it ever runs among the processes or folders of this one.
"""

import json
import os
import platform
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from league.system import exit_codes
from scripts.record import commit, machine, make_parser, write
from tests.faults.hunted import FLAGS, LEAGUE, ROOT, Hunted, Lost, examine
from tests.faults.servers import Server, programs
from tests.faults.supervisors.container import MODULES, PYTHON, Container, Impossible, hindrance, make_base
from tests.faults.supervisors.slurm import as_settings
from tests.scripts.wheel import build_wheel

HERE = {
    "--arena.name": "sumo-1v1", "--training.worlds": "16", "--rating.scripts": "pusher,random", "--rating.worlds": "16",
    "--rating.episodes_per_pair": "8", "--rating.final-episodes-per-pair": "8",
}  # fmt: skip
ROVERS = (*(HERE.get(before, word) for before, word in zip(("", *FLAGS), FLAGS, strict=False)), "--engine", "c")
STATE = "/var/lib/private/robot-league/store"  # of a user that systemd makes
SOCKETS, BLOBS = Path("/srv/postgresql"), Path("/srv/robot-league")
USER = 950  # its number on both machines, which share a folder
PAUSE = 15  # seconds before the units start a process again
COUNT = """
import sqlite3, sys
rows = "SELECT (SELECT count(*) FROM curves) + (SELECT count(*) FROM matches)"
print(*sqlite3.connect(f"file:{sys.argv[1]}?mode=ro", uri=True).execute(rows).fetchone())
"""


class Kept(Hunted):
    """A league whose blobs are beside its SQLite file."""

    @property
    def blobs(self) -> Path:
        """The folder of its blobs."""
        return Path(self.where) / "blobs"


class Machine(Container):
    """A machine on which the league is installed, with a unit that is enabled."""

    def __init__(self, base: Path, folder: Path, wheel: Path, unit: str, files: dict[str, str], shared: Any = None):
        super().__init__(base, folder, shared)
        self.unit = unit
        version = f"python{sys.version_info.major}.{sys.version_info.minor}"
        files = {
            f"/opt/league/lib/{version}/site-packages/others.pth": f"{MODULES}\n",
            f"/etc/systemd/system/{unit}.service": (ROOT / "deploy" / f"{unit}.service").read_text(),
            "/etc/hostname": f"{unit}\n",
            **{f"/etc/robot-league/{name}": text for name, text in files.items()},
        }
        self.put("/etc/ld.so.conf.d/python.conf", f"{PYTHON}/lib\n")  # where libpython is, if it is a library
        self.run("ldconfig")
        self.run(PYTHON / "bin" / version, "-m", "venv", "--without-pip", "/opt/league")
        shutil.copy(wheel, self.path("/opt"))
        pip = (PYTHON / "bin" / version, "-m", "pip", "--python", "/opt/league/bin/python")
        self.run(*pip, "install", "-q", "--no-deps", "--no-index", f"/opt/{wheel.name}")
        self.path("/usr/local/bin").mkdir(parents=True, exist_ok=True)
        self.path("/usr/local/bin/league").symlink_to("/opt/league/bin/league")
        for name, text in files.items():
            self.put(name, text)
        if shared:
            self.run("useradd", "--system", f"--uid={USER}", "--user-group", "robot-league")
        self.run("systemctl", "enable", unit)
        self.start()

    def put(self, name: str, text: str) -> None:
        """Write a file there."""
        path = self.path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def shows(self, name: str) -> str:
        """Return a property of the unit, such as NRestarts."""
        return self.call("systemctl", "show", self.unit, f"--property={name}", "--value").strip()

    def journal(self) -> str:
        """Return what the unit has said."""
        return self.call("journalctl", f"--unit={self.unit}", "--no-pager", "--output=cat")

    def becomes(self, state: str, seconds: float = 600) -> None:
        """Wait until the unit is `active`, `inactive`, `activating` or `failed`. Raises Lost."""
        self.wait(lambda: self.shows("ActiveState") == state, seconds, lambda: self.journal()[-1500:])

    def again(self, before: int) -> None:
        """Wait until systemd has started it again. Raises Lost."""
        self.wait(lambda: int(self.shows("NRestarts")) > before, 4 * PAUSE, lambda: self.journal()[-1500:])


class Case:
    """A league of one machine, which keeps its store there."""

    def __init__(self, base: Path, folder: Path, wheel: Path, steps: int, **files: str):
        self.base, self.folder, self.wheel, self.steps = base, folder, wheel, steps
        self.settings = as_settings(ROVERS) + f"budget.steps = {steps}\n"
        files = {"league.toml": self.settings, "environment": "NPROC=4\n"} | files
        self.machine = self.made("league", files)

    def made(self, unit: str, files: dict[str, str], shared: Any = None) -> Machine:
        """Make and start a machine with a unit."""
        folder = self.folder / unit
        folder.mkdir(parents=True)
        return Machine(self.base, folder, self.wheel, unit, files, shared)

    def hunted(self) -> Hunted:
        """Return the league, as it is observed from this machine."""
        return Kept(self.folder, str(self.machine.path(STATE)), self.steps)

    def progress(self, by: int = 6) -> None:
        """Wait until the league has progressed. Raises Lost."""
        enough = self.rows() + by

        def has_progressed() -> bool:
            if self.rows() < enough and self.machine.shows("ActiveState") == "inactive":
                raise Lost(f"it ended too soon to be disturbed: give more --steps\n{self.machine.journal()[:3000]}")
            return self.rows() >= enough

        self.machine.wait(has_progressed, 600, lambda: self.machine.journal()[-1500:])

    def rows(self) -> int:
        """Return how many iterations of its players and matches are in the store. Raises Lost.

        A process there counts them: SQLite follows links itself, and /proc/PID/root leads it back to this machine.
        """
        found = self.machine.call("/opt/league/bin/python", "-I", "-S", "-c", COUNT, f"{STATE}/league.db")
        if "unable to open" in found or "no such table" in found:
            return 0  # it is not made yet
        if not found.strip().isdigit():
            raise Lost(f"its rows cannot be counted: {found[-500:]}")
        return int(found)

    def done(self) -> None:
        """Wait until it has ended with success, and shut the machine down. Raises Lost."""
        self.machine.becomes("inactive", 900)
        if (code := self.machine.shows("ExecMainStatus")) != "0":
            raise Lost(f"it has ended with {code}")
        time.sleep(PAUSE + 5)
        if self.machine.shows("ActiveState") != "inactive":
            raise Lost("it was started again after its end")

    def end(self) -> None:
        """End its machines."""
        self.machine.cut()


class Served(Case):
    """A league on PostgreSQL, whose machine works too; another machine works for it. They share a folder of blobs."""

    def __init__(self, base: Path, folder: Path, wheel: Path, steps: int):
        self.blobs = folder / "blobs"
        self.blobs.mkdir(parents=True)
        os.chown(self.blobs, USER, USER)
        self.server = Server(folder / "server")
        self.url = self.server.url(folder.name)
        there = f"postgresql://league@/{folder.name}?host={SOCKETS}&port={self.server.port}"
        self.environment = f"NPROC=4\nSTORE={there}\nROBOT_LEAGUE_BLOBS={BLOBS}\n"
        self.worker: Machine | None = None
        super().__init__(base, folder, wheel, steps, environment=self.environment)

    def made(self, unit: str, files: dict[str, str], shared: Any = None) -> Machine:
        """Make and start a machine that reaches the server and the blobs."""
        return super().made(unit, files, {self.server.folder: SOCKETS, self.blobs: BLOBS})

    def hunted(self) -> Hunted:
        """Return the league, as it is observed from this machine."""
        return Hunted(self.folder, self.url, self.steps)

    def rows(self) -> int:
        """Return how many iterations of its players and matches are in the store, which this machine reaches too."""
        found = self.hunted().look(lambda store: [*store.curves(LEAGUE), *store.matches(LEAGUE)])
        return len(found or ())

    def machines(self) -> int:
        """Return on how many machines its workers are."""
        return len(self.hunted().look(lambda store: {each.host for each in store.workers(LEAGUE, 60)}) or ())

    def end(self) -> None:
        """End its machines and the server."""
        super().end()
        if self.worker is not None:
            self.worker.cut()
        self.server.stop()


# What happens to it ---------------------------------------------------------------------------------------------------


def left_alone(case: Case) -> dict[str, int]:
    """Let it run to its end."""
    return {}


def killed(case: Case) -> dict[str, int]:
    """Kill the manager, twice, and one of its workers."""
    case.progress()
    for starts in range(2):
        case.machine.call("systemctl", "kill", "--kill-whom=main", "--signal=KILL", "league")
        case.machine.again(starts)
        case.progress()
    manager = case.machine.shows("MainPID")

    def workers() -> list[str]:
        return case.machine.call("pgrep", "--parent", manager, "--full", "preflight|spawn_main").split()

    before, (first, *_) = len(workers()), workers()
    case.machine.call("kill", "-KILL", first)
    case.machine.wait(lambda: first not in workers() and len(workers()) >= before, 300, case.machine.journal)
    if case.machine.shows("MainPID") != manager:
        raise Lost("the manager did not survive its worker")
    return {"managers killed": 2, "workers killed": 1}


def stopped(case: Case) -> dict[str, int]:
    """Stop it, and start it again."""
    case.progress()
    before = case.rows()
    case.machine.call("systemctl", "stop", "league")
    state, code, result = (case.machine.shows(name) for name in ("ActiveState", "ExecMainStatus", "Result"))
    if (state, code, result) != ("inactive", "0", "success"):
        raise Lost(f"stopped, it is {state} with {code}, {result}:\n{case.machine.journal()[-1500:]}")
    kept = case.rows()
    if kept < before:
        raise Lost(f"{before} iterations and matches were there, {kept} are left")
    case.machine.call("systemctl", "start", "league")
    return {"stopped": 1}


def rebooted(case: Case) -> dict[str, int]:
    """Shut the machine down, start it, cut its power, start it."""
    case.progress()
    case.machine.shut_down()
    case.machine.start()
    case.progress()
    gone = case.machine.cut()
    case.machine.start()
    case.progress()
    return {"shut down": 1, "power cuts": 1, "processes killed": gone}


def refused(case: Case) -> dict[str, int]:
    """Give it settings that cannot be; mend them."""
    case.progress()
    case.machine.call("systemctl", "stop", "league")
    wrong = case.settings.replace('"c"', '"d"')
    case.machine.put("/etc/robot-league/league.toml", wrong)
    case.machine.call("systemctl", "start", "league")
    case.machine.becomes("failed", 120)
    time.sleep(PAUSE + 5)
    state, code, times = (case.machine.shows(name) for name in ("ActiveState", "ExecMainStatus", "NRestarts"))
    if (state, code, times) != ("failed", str(exit_codes.BAD_INPUT), "0"):
        raise Lost(f"refused, it is {state} with {code}, started again {times} times")
    if "engine" not in (said := case.machine.journal().rpartition("Starting league.service")[2]):
        raise Lost(f"nothing says why: {said}")
    case.machine.put("/etc/robot-league/league.toml", case.settings)
    case.machine.call("systemctl", "start", "league")
    return {"refused": 1}


def away(case: Case) -> dict[str, int]:
    """Stop the server, start the unit again, which finds none, and start the server; another machine joins."""
    assert isinstance(case, Served)
    case.progress()
    case.server.stop()
    case.machine.call("systemctl", "restart", "league")
    case.machine.again(1)
    if f"status={exit_codes.PASSING}/TEMPFAIL" not in case.machine.journal():
        raise Lost(f"it did not end with {exit_codes.PASSING}: {case.machine.journal()[-1500:]}")
    case.server.start()
    case.worker = case.made("league-worker", {"environment": case.environment})
    case.worker.wait(lambda: case.machines() == 2, 300, case.worker.journal)
    case.progress()
    return {"store away": 1, "workers of another machine": 1}


CASES: dict[str, Callable[[Case], dict[str, int]]] = {
    each.__name__: each for each in (left_alone, killed, stopped, rebooted, refused, away)
}


def played(
    base: Path, folder: Path, wheel: Path, name: str, steps: int, expected: Any
) -> tuple[dict[str, Any], dict[str, int]]:
    """Run a league through a case to its end; return its result, and counts. Raises Lost."""
    case = (Served if name == "away" else Case)(base, folder / name, wheel, steps)
    try:
        counts = CASES[name](case)
        restarts = int(case.machine.shows("NRestarts"))
        case.done()
        case.machine.shut_down()
        result, totals = examine(case.hunted(), expected)
        return result, {**counts, "starts by systemd": restarts, **totals}
    finally:
        case.end()


def main() -> int:
    """Run the cases; return 1 if anything was lost."""
    parser = make_parser(__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=[*CASES])
    parser.add_argument("--steps", type=int, default=5120, help="of training in a league")
    parser.add_argument("--base", type=Path, help="files of a Debian, made there if they are not (build/debian)")
    args = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # machines are ended then too
    try:
        if why := hindrance() or ("" if programs() or "away" not in args.cases else "no PostgreSQL is installed"):
            raise Impossible(why)
        base = (args.base or ROOT / "build" / "debian").resolve()
        make_base(base, platform.freedesktop_os_release().get("VERSION_CODENAME", "stable"))
        return run(args, base)
    except Impossible as error:
        print(f"not here: {error}", file=sys.stderr)
        return exit_codes.BAD_INPUT


def run(args: Any, base: Path) -> int:
    """Run the cases on machines with the files of `base`; return 1 if anything was lost."""
    found = json.loads(args.out.read_text()) if args.out and args.out.exists() else {"cases": {}, "lost": []}
    found = {"commit": args.commit or commit(), "machine": machine(), **{k: found[k] for k in ("cases", "lost")}}
    folder = Path(tempfile.mkdtemp(prefix="systemd-", dir=base.parent))  # not in /tmp: a layer is kept on a disk
    folder.chmod(0o755)  # PostgreSQL's user needs access
    (folder / "wheel").mkdir()
    wheel = build_wheel(folder / "wheel")
    expected = None
    for name in dict.fromkeys(["left_alone", *args.cases]):
        began = time.monotonic()
        try:
            result, counts = played(base, folder, wheel, name, args.steps, expected)
            expected = expected or result
        except Lost as error:
            found["lost"].append({"case": name, "what": str(error)[:1000]})
            print(f"{name}: {error}\n{folder} is kept", flush=True)
            return 1
        finally:
            if args.out is not None:
                write(found, args.out)
        before = found["cases"].get(name, {})
        found["cases"][name] = {what: before.get(what, 0) + n for what, n in {"leagues": 1, **counts}.items()}
        print(f"{name}: {json.dumps(counts)}, {time.monotonic() - began:.0f} s", flush=True)
        if args.out is not None:
            write(found, args.out)
    shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
