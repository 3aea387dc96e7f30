"""A turn's ranks on two hosts, which two network namespaces stand for: they train what one host trains.

    python -m tests.faults.supervisors.hosts --device cpu
    python -m tests.faults.supervisors.hosts --device cuda --out tests/faults/results/hosts-cuda.json

Needs root and `ip` (Debian's package `iproute2`), and with `cuda` two GPUs, one for each host. Ranks have the variables
of torchrun. NCCL takes processes of one machine for one host, so NCCL_HOSTID says otherwise: its messages then go
through sockets, which the result shows (`transports`). With `--loopback` both hosts share the machine's network, where
namespaces are refused: they differ for NCCL alone. `difference` is the largest one of a parameter of the newest
snapshots (`of`), compared with ranks that the league's own worker starts on one host; `one host` has that of such ranks
in other trainings: a second one, and one whose messages go through sockets too. Exit code 1 if that of a case is above
1e-5.
"""

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
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors.numpy import load

from league.queries.query import Open
from league.snapshots import policy_file
from scripts.record import make_parser, run_info, write
from storage.errors import StorageError
from storage.store import Store
from tests.faults.hunted import ROOT, Lost
from tests.faults.servers import free_port

LEAGUE, ITERATIONS, MOST = "hosts", 60, 1e-5
FLAGS = (
    "--arena.name", "rock-paper-scissors", "--league", LEAGUE, "--seed", "3", "--training.worlds", "16",
    "--training.rollout_length", "8", "--training.iterations_per_turn", "4", "--training.devices", "2",
    "--workers.match", "0", "--budget.rating_time", "0s", "--budget.steps", str(ITERATIONS * 16 * 8),
)  # fmt: skip
ADDRESSES = ("10.77.0.1", "10.77.0.2")


class Host(NamedTuple):
    """A network namespace that stands for a host, or the machine itself."""

    address: str
    interface: str
    namespace: str = ""

    @property
    def prefix(self) -> tuple[str, ...]:
        """The beginning of a command that runs there."""
        return ("ip", "netns", "exec", self.namespace) if self.namespace else ()


LOOPBACK = (Host("127.0.0.1", "lo"), Host("127.0.0.1", "lo"))


def ip(*words: str) -> bool:
    """Run `ip`; return whether it succeeded."""
    return subprocess.run(["ip", *words], capture_output=True, check=False).returncode == 0


@contextmanager
def namespaces() -> Iterator[tuple[Host, ...] | None]:
    """Make two network namespaces with a line, v0 to v1, between `ADDRESSES`; yield None where that is refused."""
    names = (f"league{os.getpid()}a", f"league{os.getpid()}b")
    try:
        made = shutil.which("ip") is not None and all(ip("netns", "add", name) for name in names)
        if not made or not ip("link", "add", "v0", "netns", names[0], "type", "veth", "peer", "v1", "netns", names[1]):
            yield None
            return
        hosts = tuple(
            Host(address, f"v{number}", name)
            for number, (name, address) in enumerate(zip(names, ADDRESSES, strict=True))
        )
        for host in hosts:
            for command in (
                ("addr", "add", f"{host.address}/24", "dev", host.interface),
                ("link", "set", host.interface, "up"),
                ("link", "set", "lo", "up"),
            ):
                if not ip("-n", host.namespace, *command):
                    raise OSError(f"ip -n {host.namespace} {' '.join(command)} failed")
        yield hosts
    finally:
        if shutil.which("ip") is not None:
            for name in names:
                ip("netns", "del", name)


class Case:
    """A league in a folder of its own, whose manager has no train workers."""

    def __init__(self, folder: Path, device: str, hosts: tuple[Host, ...]):
        self.folder, self.device, self.hosts, self.port = folder, device, hosts, free_port()
        folder.mkdir()
        self.manager = self.start("run", *FLAGS, "--training.device", device, "--workers", "0")

    def start(self, *words: str, prefix: tuple[str, ...] = (), **also: str) -> subprocess.Popen[bytes]:
        """Start a `league` command on the store; `also` are environment variables. What all say is in out.txt."""
        line = [*prefix, sys.executable, "-m", "league", *words, "--store", str(self.folder / "store")]
        with (self.folder / "out.txt").open("ab") as out:
            return subprocess.Popen(line, cwd=ROOT, stdout=out, stderr=out, env={**os.environ, **also})

    def ranks(self) -> list[subprocess.Popen[bytes]]:
        """Start a rank on each host."""
        return [
            self.start(
                "worker", "--ranks", "--wait", "--league", LEAGUE, prefix=host.prefix, RANK=str(rank), WORLD_SIZE="2",
                LOCAL_RANK="0", MASTER_ADDR=self.hosts[0].address, MASTER_PORT=str(self.port), **self.own(rank),
            )
            for rank, host in enumerate(self.hosts)
        ]  # fmt: skip

    def own(self, rank: int) -> dict[str, str]:
        """Return what a host has of its own: a GPU, a name, and the network to the other one."""
        interface = self.hosts[rank].interface
        if self.device == "cpu":
            return {"GLOO_SOCKET_IFNAME": interface}
        network = {"NCCL_SOCKET_IFNAME": interface, "NCCL_HOSTID": f"host{rank}", "NCCL_IB_DISABLE": "1"}
        return {"CUDA_VISIBLE_DEVICES": str(rank), "NCCL_DEBUG": "INFO", **network}

    def learning(self) -> None:
        """Wait until the ranks learn. Raises Lost after five minutes."""
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline:
            with suppress(StorageError, FileNotFoundError), Store.open(self.folder / "store") as store:
                if any(worker.status.get("iteration") for worker in store.workers(LEAGUE, 5)):
                    return
            time.sleep(0.1)
        raise Lost(f"the ranks did not learn:\n{self.said()}")

    def ended(self, processes: list[subprocess.Popen[bytes]], codes: list[int]) -> None:
        """Wait until processes have ended. Raises Lost if they end with other codes."""
        found = [process.wait(300) for process in processes]
        if found != codes:
            raise Lost(f"exit codes {found} instead of {codes}:\n{self.said()}")

    def said(self) -> str:
        """Return the end of what its processes said."""
        return (self.folder / "out.txt").read_text(errors="replace")[-3000:]

    def learnt(self) -> dict[str, Any]:
        """Return the ways by which NCCL's messages went, and whether updates were CUDA graphs."""
        text = (self.folder / "out.txt").read_text(errors="replace")
        ways = sorted(set(re.findall(r"via (\w+(?:/\w+)?)", text)))
        return {"transports": ways, "graphs": self.device == "cuda" and "without CUDA graphs" not in text}


def undisturbed(case: Case) -> dict[str, Any]:
    """Let two hosts train to the end."""
    case.ended(case.ranks(), [0, 0])
    return {}


def host_killed(case: Case) -> dict[str, Any]:
    """Kill the second host's rank in a turn; start both again."""
    first, second = case.ranks()
    case.learning()
    first.send_signal(signal.SIGSTOP)  # so that the turn does not end before
    time.sleep(1)
    second.kill()
    first.send_signal(signal.SIGCONT)
    case.ended([first, second], [75, -signal.SIGKILL])
    case.ended(case.ranks(), [0, 0])
    with Store.open(case.folder / "store") as store:
        return {"turns done again": sum(job.failures for job in store.jobs(LEAGUE))}


CONTROLS: dict[str, dict[str, dict[str, str]]] = {
    "cpu": {"again": {}},
    "cuda": {"again": {}, "sockets": {"NCCL_P2P_DISABLE": "1", "NCCL_SHM_DISABLE": "1", "NCCL_IB_DISABLE": "1"}},
}
CASES: dict[str, Callable[[Case], dict[str, Any]]] = {"undisturbed": undisturbed, "host killed": host_killed}


def parameters(folder: Path) -> dict[str, np.ndarray]:
    """Return all parameters of the players' newest snapshots, and check that they had all iterations."""
    found: dict[str, np.ndarray] = {}
    with Store.open(folder / "store") as store:
        opened = Open(store, LEAGUE)
        for player in store.players(LEAGUE):
            newest = max(store.snapshots(LEAGUE, player.name), key=lambda snapshot: snapshot.iteration)
            if newest.iteration != ITERATIONS:
                raise Lost(f"{newest.name} is the newest after {ITERATIONS} iterations")
            arrays = load(policy_file.export(opened, newest.name).to_bytes())
            found |= {f"{player.name} {name}": array for name, array in arrays.items()}
    return found


def difference(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return the largest `difference` of a parameter, and `of` which. Raises Lost if parameters are missing."""
    if one.keys() != other.keys():
        raise Lost(f"parameters differ: {sorted(one.keys() ^ other.keys())}")
    found = {name: float(np.abs(one[name].astype(np.float64) - other[name]).max()) for name in one if one[name].size}
    name = max(found, key=found.__getitem__)
    return {"difference": found[name], "of": name}


def on_one_host(folder: Path, device: str, **variables: str) -> dict[str, np.ndarray]:
    """Return the parameters that two ranks of one host learn, which the league's own worker starts.

    `variables` are of the league's environment, beside this process's own.
    """
    line = [
        sys.executable,
        "-m",
        "league",
        "run",
        *FLAGS,
        "--training.device",
        device,
        "--store",
        str(folder / "store"),
    ]
    folder.mkdir()
    environment = {**os.environ, **variables}
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise Lost(f"one host alone: exit code {done.returncode}:\n{done.stderr[-3000:]}")
    return parameters(folder)


def main() -> int:
    """Run the cases; return 1 if anything was lost or differs."""
    parser = make_parser(__doc__)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--loopback", action="store_true", help="both hosts share this machine's network")
    args = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="hosts-"))
    with nullcontext(LOOPBACK) if args.loopback else namespaces() as hosts:
        if hosts is None:
            sys.exit("network namespaces need root, `ip` and permission; --loopback does without")
        expected = on_one_host(folder / "one", args.device)
        network = "loopback" if args.loopback else "namespaces"
        about = {"device": args.device, "network": network, "iterations": ITERATIONS}
        result = {**run_info(args.commit), **about, "one host": {}, "cases": {}}
        for name, variables in CONTROLS[args.device].items():
            found = difference(on_one_host(folder / name, args.device, **variables), expected)
            result["one host"][name] = found
            print(f"one host, {name}: {json.dumps(found)}", flush=True)
        for name, run in CASES.items():
            began, case = time.monotonic(), Case(folder / name.replace(" ", "-"), args.device, hosts)
            try:
                counts = run(case)
                case.ended([case.manager], [0])
            finally:
                case.manager.kill()
            counts |= {**case.learnt(), **difference(parameters(case.folder), expected)}
            result["cases"][name] = counts
            print(f"{name}: {json.dumps(counts)}, {time.monotonic() - began:.0f} s", flush=True)
    if args.out is not None:
        write(result, args.out)
    shutil.rmtree(folder, ignore_errors=True)
    return int(any(case["difference"] > MOST for case in result["cases"].values()))


if __name__ == "__main__":
    sys.exit(main())
