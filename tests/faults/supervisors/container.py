"""A machine made of namespaces: a Debian whose first process is systemd, which sees nothing of the machine around it.

Debian's `debootstrap` makes its files, `systemd-nspawn` starts it. It runs in namespaces of mounts, processes, network,
names and control groups of its own; /tmp, /run and all other folders are its own, and so are its control groups, in a
group of their own. `apart` compares them with this machine's before systemd is started there.
"""

import os
import platform
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.faults.hunted import Lost

PROGRAMS = ("systemd-nspawn", "debootstrap", "unshare", "nsenter")
PACKAGES = "systemd,systemd-sysv,dbus,procps,python3"  # python3: for the libraries that PYTHON is linked to
PYTHON, MODULES = Path("/opt/python"), Path("/opt/modules")
OWN = ("/", "/tmp", "/run", "/dev", "/dev/shm", "/var/tmp", "/home", "/root")

# In namespaces of its own: control groups from that of the container down; its files, a layer over those of the base;
# and /run and /tmp of systemd-nspawn itself, which makes folders there.
_START = r"""
set -e
mount -t cgroup2 none /sys/fs/cgroup
base=$1 layer=$2; shift 2
mount -t tmpfs none /run
mkdir /run/root /run/shared
mount -t overlay overlay -o "lowerdir=$base,upperdir=$layer/files,workdir=$layer/work" /run/root
binds=()
while [ "$1" != -- ]; do
    to=/run/shared/${#binds[@]}
    mkdir "$to"
    mount --bind "$2" "$to"
    binds+=("--bind$1=$to:$3")
    shift 3
done
shift
mount -t tmpfs none /tmp
exec systemd-nspawn --quiet --register=no --keep-unit --private-network --machine=league \
    --directory=/run/root "${binds[@]}" "$@"
"""


class Impossible(Exception):  # noqa: N818
    """This machine cannot hold such a container; the message says why."""


def hindrance() -> str:
    """Return what is missing for a container on this machine; nothing if nothing is."""
    if platform.system() != "Linux":
        return "this is no Linux"
    if os.geteuid() != 0:
        return "namespaces of this kind are for root"
    if absent := [name for name in PROGRAMS if shutil.which(name) is None]:
        return f"no {', '.join(absent)} (apt-get install debootstrap systemd-container)"
    if "\toverlay\n" not in Path("/proc/filesystems").read_text():
        return "this kernel has no overlay file system"
    return "" if unified() else "control groups of version 2 are mounted nowhere"


def unified() -> Path | None:
    """Return where control groups of version 2 are mounted; None if they are not."""
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, place, kind, *_ = line.split()
        if kind == "cgroup2":
            return Path(place)
    return None


def make_base(base: Path, suite: str) -> None:
    """Make the files of a small Debian with systemd, unless they are there. Raises Impossible."""
    if (base / "lib" / "systemd" / "systemd").exists():
        return
    print(f"Making a Debian ({suite}) in {base}; this takes minutes.", flush=True)
    made = base.with_name(f".{base.name}")
    shutil.rmtree(made, ignore_errors=True)
    made.parent.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", suite, made], capture_output=True, text=True
    )
    if done.returncode:
        raise Impossible(f"debootstrap: {done.stdout[-500:]}")
    made.replace(base)


class Container:
    """A machine of its own on the files of a base, whose changes it keeps in a folder until that is removed."""

    def __init__(self, base: Path, folder: Path, shared: dict[Path, Path] | None = None):
        """Prepare it. `shared` are folders of this machine that it may write to, each with its place there.

        Raises Impossible if it would see anything else of this machine that it could change.
        """
        self.base, self.folder = base, folder
        modules = Path(sysconfig.get_path("purelib"))
        self._binds = [("-ro", Path(sys.base_prefix), PYTHON), ("-ro", modules, MODULES)]
        self._binds += [("", here, there) for here, there in (shared or {}).items()]
        self._process: subprocess.Popen[bytes] | None = None
        root = unified()
        assert root is not None
        self._group = root / f"robot-league-{os.getpid()}-{folder.name}"
        for name in ("files", "work"):
            (folder / name).mkdir(parents=True)
        self.apart()

    def apart(self) -> None:
        """Compare the folders and control groups that it sees with this machine's. Raises Impossible."""
        stated = self.run("stat", "--format=%n %d:%i", *OWN).splitlines()
        seen = dict(line.rsplit(" ", 1) for line in stated)
        ours = {name: f"{at.st_dev}:{at.st_ino}" for name in OWN if (at := os.stat(name))}
        groups = self.run("cat", "/proc/self/cgroup", "/proc/1/comm")
        if set(seen) != set(OWN) or any(seen[name] == ours[name] for name in OWN):
            raise Impossible(f"it would see folders of this machine: {seen}, {ours}")
        if "robot-league" in groups:
            raise Impossible(f"it would see control groups of this machine: {groups}")

    def _command(self, *also: object) -> list[str]:
        """Return the command line of a process that starts the container, in a control group of its own."""
        self._group.mkdir(exist_ok=True)
        join = f"echo $$ > '{self._group}/cgroup.procs'; exec unshare --mount --cgroup --pid --ipc --uts --net --fork \
            --kill-child --propagation private --mount-proc bash -c \"$@\""
        binds = [str(word) for bind in self._binds for word in bind]
        return [
            "bash", "-c", join, "bash", _START, "bash", str(self.base), str(self.folder), *binds, "--",
            *map(str, also),
        ]  # fmt: skip

    def run(self, *command: object) -> str:
        """Run a command as the only process of the container, which is not started; return what it prints.

        Raises Impossible if it fails.
        """
        call = self._command("--pipe", *command)
        done = subprocess.run(call, capture_output=True, text=True, timeout=300, stdin=subprocess.DEVNULL)
        self._sweep()
        if done.returncode:
            raise Impossible(f"{' '.join(map(str, command))}: {done.stderr.strip()[-500:]}")
        return done.stdout

    def start(self) -> None:
        """Start systemd, and wait until it has started all that it should. Raises Lost."""
        with (self.folder / "console").open("ab") as out:
            call = self._command("--console=pipe", "--boot")
            self._process = subprocess.Popen(call, stdout=out, stderr=out, stdin=subprocess.DEVNULL)
        self.wait(lambda: self.pid() and self.call("systemctl", "is-system-running").strip() == "running", 90)

    def pid(self) -> int:
        """Return the number of its first process on this machine; 0 if there is none."""
        with suppress(OSError):
            found = (self._group / "payload" / "init.scope" / "cgroup.procs").read_text().split()
            return int(found[0]) if found else 0
        return 0

    def call(self, *command: object) -> str:
        """Run a command in the running container; return what it prints on both of its outputs."""
        path = "PATH=/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
        enter = ["nsenter", "--target", str(self.pid()), "--all", "--", "env", "-i", path, *map(str, command)]
        return subprocess.run(enter, stdout=-1, stderr=subprocess.STDOUT, text=True, timeout=150).stdout

    def path(self, there: str) -> Path:
        """Return the path here of a file there, whether the container runs or not."""
        pid = self.pid()
        return Path(f"/proc/{pid}/root{there}") if pid else Path(f"{self.folder}/files{there}")

    def wait(self, until: Callable[[], Any], seconds: float, what: Callable[[], str] = lambda: "") -> None:
        """Wait until `until()` is true. Raises Lost after so many seconds, with the words of `what`."""
        deadline = time.monotonic() + seconds
        while not until():
            if time.monotonic() > deadline:
                raise Lost(f"nothing changed in {seconds:.0f} s: {what()}")
            time.sleep(0.3)

    def shut_down(self) -> None:
        """Let systemd stop its services and end, as a machine does that is shut down."""
        self.call("systemctl", "poweroff")
        assert self._process is not None
        self._process.wait(180)
        self.cut()

    def cut(self) -> int:
        """End all its processes at once, as a power cut does; return how many there were."""
        killed = sum(1 for _ in self._members())
        with suppress(FileNotFoundError):
            (self._group / "cgroup.kill").write_text("1")
        if self._process is not None:
            self._process.wait(60)
        self._sweep()
        return killed

    def _members(self) -> Iterator[str]:
        for file in self._group.rglob("cgroup.procs"):
            yield from file.read_text().split()

    def _sweep(self) -> None:
        """Remove its control groups once they are empty."""
        self.wait(lambda: not any(self._members()), 60)
        for group in sorted((path for path in self._group.rglob("*") if path.is_dir()), reverse=True):
            self.wait(lambda group=group: _removed(group), 60)
        self.wait(lambda: _removed(self._group), 60)


def _removed(group: Path) -> bool:
    """Remove a control group; return false while the kernel still holds processes in it that have ended."""
    try:
        group.rmdir()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return True
