"""A small league for a day, in parts: memory, file handles, disk, WAL and speed of its processes, for leaks and drift.

    python -m benchmarks.soak --folder FOLDER --for 3h --out benchmarks/results/soak-cpu.json
    python -m benchmarks.soak --folder FOLDER --for 0 --out benchmarks/results/soak-cpu.json   # draw it again

`league run` of rovers' sumo 1v1 on the C engine (64 worlds, PFSP, a snapshot each 400,000 steps) runs in FOLDER beside
`league thin` every quarter of an hour. A part goes on from the store in FOLDER. Where that is gone it goes on from the
pack which the part before wrote (`--pack`), else with a new league, and the result says which. A league that dies is
started again and counted. Each sample, every 30 s, is a line of a file in FOLDER; the result has their means over five
minutes, and `benchmarks/soak_report.py` makes slopes and a figure beside it. Speed is in steps per second of the
learner's processors too, because others may share the machine. Linux only.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from league.system import environment

environment.prepare()

from benchmarks import soak_report
from league.config.durations import seconds
from scripts.record import commit, make_parser, run_info
from storage.errors import StorageError
from storage.store import Store

LEAGUE = "soak"
SETTINGS = f"""\
league = "{LEAGUE}"
[arena]
name = "sumo-1v1"
[training]
worlds = 64
iterations_per_turn = 4
[training.opponents]
kind = "pfsp"
[learner.architecture]
hidden = [32, 32]
[[roles]]
name = "main"
timeout = 400000
"""
EVERY, THIN_EVERY = 30.0, 900.0  # seconds
THIN = ("--checkpoints", "2", "--recordings", "100", "--snapshots", "2", "--age", "1h")
PACK = "soak.league.zip"
MB = 1e6
TICKS = os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Run a part, then write the result of all parts and its figure."""
    parser = make_parser(__doc__, out_required=True)
    parser.add_argument("--folder", type=Path, required=True, help="the store, samples and logs of all parts")
    parser.add_argument("--for", dest="duration", default="3h", help="of this part; 0 draws the figure again")
    parser.add_argument("--pack", type=Path, help=f"what the part before wrote (default: {PACK} in the folder)")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    args.pack = args.pack or args.folder / PACK
    if limit := seconds(args.duration):
        Part(args).run(limit)
    known = json.loads(args.out.read_text())["parts"] if args.out.exists() else []
    here = [soak_report.part(file) for file in args.folder.glob("part-*.jsonl")]  # those of lost machines are not
    by_name = {each["name"]: each for each in (*known, *here)}
    parts = [by_name[name] for name in sorted(by_name)]
    result = {**run_info(args.commit), "parts": parts, "report": soak_report.report(parts)}
    soak_report.write(result, args.out)
    print(json.dumps(result["report"], indent=1))


@dataclass
class Part:
    """One uninterrupted run of the league, with its samples."""

    args: argparse.Namespace
    process: subprocess.Popen[bytes] | None = None
    exits: list[int] = field(default_factory=list)  # codes of a league that ended before its time
    used: dict[tuple[int, str], tuple[str, float]] = field(default_factory=dict)  # role and seconds of each process

    def run(self, limit: float) -> None:
        """Run the league for so many seconds, stop it and pack it."""
        store, began = self.args.folder / "store", time.time()
        origin = self._restore(store)
        samples = self.args.folder / time.strftime("part-%Y%m%dT%H%M%SZ.jsonl", time.gmtime(began))
        with samples.open("w") as out:
            head = {"origin": origin, "began": began, "every": EVERY, "commit": self.args.commit or commit()}
            print(json.dumps(head), file=out, flush=True)
            thinned = sampled = time.monotonic()
            try:
                while time.time() < began + limit:
                    self._keep_running(store)
                    time.sleep(1.0)
                    if time.monotonic() >= sampled + EVERY:
                        sampled += EVERY
                        with suppress(StorageError):
                            print(json.dumps(self._sample(store)), file=out, flush=True)
                    if time.monotonic() >= thinned + THIN_EVERY:
                        thinned = time.monotonic()
                        self._league("thin", *THIN, store=store)
            finally:
                self._stop()
                print(json.dumps({"ended": time.time(), "exits": self.exits}), file=out, flush=True)
        new = self.args.pack.with_suffix(".new.zip")
        new.unlink(missing_ok=True)
        self._league("pack", str(new), "--newest", store=store)
        new.replace(self.args.pack)

    def _restore(self, store: Path) -> str:
        """Return from what the league goes on: its store, a pack or nothing."""
        if store.exists():
            return "store"
        if self.args.pack.exists():
            self._league("unpack", str(self.args.pack), store=store)
            return "pack"
        return "nothing"

    def _keep_running(self, store: Path) -> None:
        """Start the league unless it runs."""
        if self.process is not None and (code := self.process.poll()) is not None:
            self.exits.append(code)
            time.sleep(5.0)
        if self.process is None or self.process.poll() is not None:
            settings = self.args.folder / "league.toml"
            settings.write_text(SETTINGS)
            with (self.args.folder / "league.log").open("ab") as log:
                call = [sys.executable, "-m", "league", "run", str(settings), "--store", str(store)]
                self.process = subprocess.Popen(call, stdout=log, stderr=log, start_new_session=True)

    def _stop(self) -> None:
        """Ask the league to end, and wait for it."""
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            self.process.wait(180)

    def _league(self, *words: str, store: Path) -> None:
        """Run a command of the league to its end, with what it says in the log."""
        with (self.args.folder / "commands.log").open("ab") as log:
            call = [sys.executable, "-m", "league", *words, "--store", str(store)]
            subprocess.run(call, stdout=log, stderr=log, check=True)

    def _sample(self, store: Path) -> dict[str, Any]:
        """Return what the processes use now, and what the store holds."""
        with Store.open(str(store)) as opened:
            kinds = {worker.pid: worker.kinds for worker in opened.workers(LEAGUE, 120.0)}
            steps = max((each.step for each in opened.newest_checkpoints(LEAGUE).values()), default=0)
            there, thinned = opened.snapshot_count(LEAGUE)
            counts = {
                "steps": steps, "games": opened.booked_episodes(LEAGUE), "snapshots": there, "thinned": thinned,
                "matches": opened.last_match(LEAGUE),
            }  # fmt: skip
        roles: dict[str, dict[str, float]] = {}
        for pid, role in self._processes(kinds).items():
            with suppress(OSError, ValueError):  # it has just ended
                found = usage(pid)
                start = str(found.pop("start"))
                self.used[pid, start] = (role, found.pop("cpu"))
                sums = roles.setdefault(role, dict.fromkeys(("processes", *found), 0))
                for key, value in {"processes": 1, **found}.items():
                    sums[key] += value
        for role, sums in roles.items():
            sums["cpu"] = sum(spent for who, spent in self.used.values() if who == role)
        return {"time": time.time(), **counts, "disk": disk(store), "roles": roles, "load": os.getloadavg()[0]}

    def _processes(self, kinds: dict[int, str]) -> dict[int, str]:
        """Return the role of each process: one that has not registered has its parent's, as helper of it."""
        assert self.process is not None
        parents = {}
        for entry in Path("/proc").iterdir():
            with suppress(OSError, ValueError):
                parents[int(entry.name)] = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
        found, new = {}, {self.process.pid: "manager"}
        while new:
            found |= new
            below = {pid: parent for pid, parent in parents.items() if parent in new}
            new = {
                pid: kinds.get(pid, f"{found[parent].removesuffix('-helper')}-helper") for pid, parent in below.items()
            }
        return found


def usage(pid: int) -> dict[str, float]:
    """Return memory in MB (resident, proportional, own), file handles, threads and processor seconds of a process."""
    folder = Path("/proc", str(pid))
    stat = (folder / "stat").read_text().rpartition(")")[2].split()
    rollup = dict.fromkeys(("Rss", "Pss", "Private_Clean", "Private_Dirty"), 0)
    for line in (folder / "smaps_rollup").read_text().splitlines()[1:]:
        key, value = line.split()[:2]
        if key[:-1] in rollup:
            rollup[key[:-1]] = int(value) * 1024
    return {
        "rss": rollup["Rss"] / MB, "pss": rollup["Pss"] / MB,
        "uss": (rollup["Private_Clean"] + rollup["Private_Dirty"]) / MB,
        "files": len(os.listdir(folder / "fd")), "threads": int(stat[17]),
        "cpu": (int(stat[11]) + int(stat[12])) / TICKS, "start": float(stat[19]),
    }  # fmt: skip


def disk(store: Path) -> dict[str, float]:
    """Return MB of the database, its WAL and its blobs, and the number of blobs."""
    size, blobs = 0, 0
    for folder, _, names in os.walk(store / "blobs"):
        for name in names:
            with suppress(OSError):
                size, blobs = size + os.stat(Path(folder, name)).st_size, blobs + 1
    files = {key: store / f"league.db{end}" for key, end in (("database", ""), ("wal", "-wal"))}
    found = {key: file.stat().st_size / MB if file.exists() else 0.0 for key, file in files.items()}
    return {**found, "blobs": size / MB, "blob_files": blobs}


if __name__ == "__main__":
    main()
