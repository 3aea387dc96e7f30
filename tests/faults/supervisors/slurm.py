"""A league on a real Slurm cluster of one machine: jobs requeued, cancelled, out of time, on nodes that drain or die.

    python -m tests.faults.supervisors.slurm --out tests/faults/results/slurm-cpu.json
    python -m tests.faults.supervisors.slurm --cases requeued cancelled

Starts `slurmctld` and two `slurmd` without accounting (Debian's package `slurm-wlm`) and a PostgreSQL server of its
own, and submits `deploy/league.sbatch` as it is, with another time limit. Both nodes say that they have a GPU, which
none of them uses. Needs root, as `slurmd` does. Each case is a league of its own that is run to its end: all scheduled
matches must be in the log once and nothing else, and parameters, curves, log and ratings must equal those of an
undisturbed league of the same seed. Counts add up over runs. Exit code 1 if anything was lost.
"""

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from socket import gethostname
from typing import Any

from scripts.record import commit, machine, make_parser, write
from tests.faults.hunted import FLAGS, ROOT, Hunted, Lost, environment, examine
from tests.faults.servers import Server, free_port

NODES = ("n1", "n2")
LISTS = ("rating.scripts", "learner.architecture.hidden")
SETTINGS = """\
ClusterName=league
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={port}
SlurmUser=root
AuthType=auth/none
CredType=cred/none
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
StateSaveLocation={folder}/state
SlurmctldPidFile={folder}/controller.pid
SlurmctldLogFile={folder}/controller.log
SlurmdSpoolDir={folder}/%n
SlurmdPidFile={folder}/%n.pid
SlurmdLogFile={folder}/%n.log
SlurmdTimeout=10
SlurmdParameters=config_overrides
ReturnToService=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
GresTypes=gpu
KillWait=20
PartitionName=all Nodes=ALL Default=YES State=UP
"""


class Cluster:
    """A Slurm cluster of this machine, in a folder of its own; its nodes are processes."""

    def __init__(self, folder: Path):
        self.folder, host = folder, gethostname().partition(".")[0]
        text = SETTINGS.format(host=host, port=free_port(), folder=folder)
        for node in NODES:
            (folder / node).mkdir(parents=True)
            text += f"NodeName={node} NodeHostname={host} NodeAddr=127.0.0.1 Port={free_port()} CPUs=8 Gres=gpu:1\n"
        (folder / "slurm.conf").write_text(text)
        (folder / "gres.conf").write_text("Name=gpu File=/dev/null\n")
        self.environment = {**environment(), "SLURM_CONF": str(folder / "slurm.conf")}
        self.environment["PATH"] = f"{Path(sys.executable).parent}:{self.environment['PATH']}"
        self.call("slurmctld")
        for node in NODES:
            self.start_node(node)
        self.wait(lambda: self.idle() == set(NODES), 60)

    def call(self, *command: object) -> str:
        """Return what a command prints. Raises CalledProcessError if it fails."""
        done = subprocess.run([*map(str, command)], env=self.environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise subprocess.CalledProcessError(done.returncode, command[0], done.stdout, done.stderr)
        return done.stdout.strip()

    def start_node(self, node: str) -> None:
        """Start a node's daemon."""
        self.call("slurmd", "-N", node)

    def idle(self) -> set[str]:
        """Return the nodes that are free for jobs."""
        return set(self.call("sinfo", "--noheader", "--Node", "--states=idle", "--format=%N").split())

    def submit(self, settings: Path, store: str, blobs: Path, *options: str) -> str:
        """Submit the script of `deploy/`; return the job's number."""
        given = f"--export=ALL,STORE={store},ROBOT_LEAGUE_BLOBS={blobs}"
        output = f"--output={settings.with_suffix('.out')}"
        script = ROOT / "deploy" / "league.sbatch"
        return self.call(
            "sbatch", "--parsable", given, output, f"--chdir={settings.parent}", *options, script, settings
        )

    def field(self, job: str, name: str) -> str:
        """Return a field of a job, such as JobState or Restarts."""
        found = re.search(rf"\b{name}=(\S*)", self.call("scontrol", "show", "job", job))
        return found[1] if found else ""

    def wait(self, until: Callable[[], Any], seconds: float) -> None:
        """Wait until `until()` is true. Raises Lost after so many seconds."""
        deadline = time.monotonic() + seconds
        while not until():
            if time.monotonic() > deadline:
                raise Lost(f"nothing changed in {seconds:.0f} s:\n{self.call('squeue', '--long')}")
            time.sleep(0.3)

    def kill_node(self, node: str) -> int:
        """End a node as a power cut does, with all that runs on it; return how many processes were killed."""
        there = {pid for pid in _pids() if f"SLURMD_NODENAME={node}".encode() in _read(pid, "environ").split(b"\0")}
        keepers = {above for pid in there if b"slurmstepd" in _read(above := _parent(pid), "cmdline")}
        killed = {int((self.folder / f"{node}.pid").read_text())} | keepers | there
        for pid in killed:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        return len(killed)

    def end(self) -> None:
        """End its daemons and the jobs that are left."""
        with suppress(subprocess.CalledProcessError):
            self.call("scancel", "--full", "--signal=KILL", "--partition=all")
        for name in (*NODES, "controller"):
            with suppress(FileNotFoundError, ProcessLookupError, ValueError):
                os.kill(int((self.folder / f"{name}.pid").read_text()), signal.SIGTERM)


def _pids() -> Iterator[int]:
    for folder in Path("/proc").glob("[0-9]*"):
        yield int(folder.name)


def _read(pid: int, name: str) -> bytes:
    """Return a file of a process in /proc; nothing if it has ended."""
    try:
        return Path(f"/proc/{pid}/{name}").read_bytes()
    except OSError:
        return b""


def _parent(pid: int) -> int:
    return int(_read(pid, "stat").rpartition(b")")[2].split()[1] or 0)


@contextmanager
def cluster(folder: Path) -> Iterator[Cluster]:
    """Yield a running cluster, and end it."""
    made = Cluster(folder)
    try:
        yield made
    finally:
        made.end()


# What happens to a job ------------------------------------------------------------------------------------------------


class Case:
    """A league, and the jobs that run it."""

    def __init__(self, on: Cluster, hunted: Hunted, settings: Path):
        self.cluster, self.hunted, self.settings = on, hunted, settings
        self.job = self.submit()

    def submit(self, *options: str) -> str:
        """Submit the league."""
        resources = ("--cpus-per-task=4", "--time=60", *options)
        return self.cluster.submit(self.settings, self.hunted.where, self.hunted.blobs, *resources)

    def state(self) -> str:
        """Return the state of the newest job."""
        return self.cluster.field(self.job, "JobState")

    def progress(self, by: int = 6) -> None:
        """Wait until the league has progressed."""
        since = self.hunted.revision()
        self.cluster.wait(lambda: self.hunted.revision() >= since + by, 240)

    def back(self) -> None:
        """Wait until the job is back in the queue, and let it start without the two minutes that Slurm holds it."""
        self.cluster.wait(lambda: self.state() == "PENDING", 120)
        time.sleep(5)  # in the second of its end a node would take the new start for the old one, and kill it
        self.cluster.call("scontrol", "update", f"jobid={self.job}", "starttime=now")

    def done(self, seconds: float = 600) -> None:
        """Wait until the job is done. Raises Lost if it failed."""
        self.cluster.wait(lambda: self.state() not in ("PENDING", "RUNNING", "COMPLETING", "REQUEUED"), seconds)
        if self.state() != "COMPLETED":
            raise Lost(f"the job is {self.state()}:\n{self.settings.with_suffix('.out').read_text()[-2000:]}")


def left_alone(case: Case) -> dict[str, int]:
    """Let it run to its end."""
    return {}


def requeued(case: Case) -> dict[str, int]:
    """Requeue it, twice."""
    for _ in range(2):
        case.progress()
        case.cluster.call("scontrol", "requeue", case.job)
        case.back()
    return {"requeued": 2}


def cancelled(case: Case) -> dict[str, int]:
    """Cancel it, and submit it again."""
    case.progress()
    case.cluster.call("scancel", case.job)
    case.cluster.wait(lambda: case.state() == "CANCELLED" and case.cluster.idle() == set(NODES), 60)
    case.job = case.submit()
    return {"cancelled": 1}


def drained(case: Case) -> dict[str, int]:
    """Drain a node, requeue the job, which then waits, and take the node back."""
    case.progress()
    node = NODES[1]
    case.cluster.call("scontrol", "update", f"nodename={node}", "state=drain", "reason=a disk is changed")
    case.progress(2)  # what runs there goes on
    case.cluster.call("scontrol", "requeue", case.job)
    case.back()
    time.sleep(10)
    if case.state() != "PENDING":
        raise Lost(f"it is {case.state()} with a node too few")
    case.cluster.call("scontrol", "update", f"nodename={node}", "state=resume")
    return {"nodes drained": 1}


def node_died(case: Case) -> dict[str, int]:
    """Kill a node and all that runs on it; it comes back later."""
    case.progress()
    killed = case.cluster.kill_node(NODES[1])
    case.back()
    case.cluster.start_node(NODES[1])
    return {"nodes killed": 1, "processes killed": killed}


def out_of_time(case: Case) -> dict[str, int]:
    """Give it a time limit of two minutes and a signal at their begin, so that it requeues itself."""
    case.cluster.call("scancel", case.job)
    case.cluster.wait(lambda: case.cluster.idle() == set(NODES), 60)
    case.job = case.submit("--time=2", "--signal=B:USR1@100")
    case.cluster.wait(lambda: case.state() == "PENDING" and case.cluster.field(case.job, "Restarts") == "1", 300)
    case.cluster.call("scontrol", "update", f"jobid={case.job}", "timelimit=60")
    case.back()
    return {"requeued by itself": 1}


CASES: dict[str, Callable[[Case], dict[str, int]]] = {
    each.__name__: each for each in (left_alone, requeued, cancelled, drained, node_died, out_of_time)
}


def played(on: Cluster, server: Server, folder: Path, name: str, steps: int, expected: Any) -> dict[str, int]:
    """Run a league through a case to its end; return counts. Raises Lost."""
    hunted = Hunted(folder / name, server.url(name), steps)
    settings = hunted.folder / "league.toml"
    settings.write_text(as_settings(FLAGS) + f"budget.steps = {steps}\n")
    case = Case(on, hunted, settings)
    counts = CASES[name](case)
    case.done()
    restarts = int(on.field(case.job, "Restarts"))
    return {**counts, "restarts of jobs": restarts, **examine(hunted, expected)[1]}


def as_settings(flags: tuple[str, ...]) -> str:
    """Return flags of `league run` as lines of a league.toml."""
    lines = []
    for flag, text in pairwise([*flags, "--"]):
        if flag.startswith("--"):
            key = flag[2:].replace("-", "_")
            values = [_literal(each) for each in text.split(",")] if not text.startswith("--") else ["true"]
            value = f"[{', '.join(values)}]" if key in LISTS else values[0]
            lines.append(f"{key} = {value}\n")
    return "".join(lines)


def _literal(text: str) -> str:
    return text if text in ("true", "false") or text.isdigit() else json.dumps(text)


def main() -> int:
    """Run the cases; return 1 if anything was lost."""
    parser = make_parser(__doc__)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=[*CASES])
    parser.add_argument("--steps", type=int, default=20_480, help="of training in a league")
    args = parser.parse_args()
    found = json.loads(args.out.read_text()) if args.out and args.out.exists() else {"cases": {}, "lost": []}
    found = {"commit": args.commit or commit(), "machine": machine(), **{k: found[k] for k in ("cases", "lost")}}
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))
    folder.chmod(0o755)  # PostgreSQL's user needs access
    found["slurm"] = subprocess.run(["slurmd", "-V"], capture_output=True, text=True, check=True).stdout.strip()
    alone = Hunted(folder / "alone", str(folder / "alone"), args.steps)
    alone.finish()
    expected, server = examine(alone)[0], Server(folder / "server")
    try:
        with cluster(folder / "cluster") as on:
            for name in args.cases:
                began = time.monotonic()
                try:
                    counts = played(on, server, folder, name, args.steps, expected)
                except Lost as error:
                    found["lost"].append({"case": name, "what": str(error)[:1000]})
                    print(f"{name}: {error}\n{folder} is kept", flush=True)
                    return 1
                finally:
                    write_counts(found, args)
                before = found["cases"].get(name, {})
                summed = {what: before.get(what, 0) + n for what, n in {"leagues": 1, **counts}.items()}
                found["cases"][name] = summed
                print(f"{name}: {json.dumps(counts)}, {time.monotonic() - began:.0f} s", flush=True)
                write_counts(found, args)
    finally:
        server.stop()
    shutil.rmtree(folder, ignore_errors=True)
    return 0


def write_counts(found: dict[str, Any], args: argparse.Namespace) -> None:
    """Write the counts so far."""
    if args.out is not None:
        write(found, args.out)


if __name__ == "__main__":
    sys.exit(main())
