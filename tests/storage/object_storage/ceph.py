"""A Ceph cluster of this machine with its S3 gateway: Debian's packages ceph-mon, ceph-osd and radosgw, as processes.

One monitor, one store of objects in memory, one gateway, in a folder of their own and on 127.0.0.1 only.
"""

import json
import os
import shutil
import signal
import subprocess
import time
import uuid
from contextlib import suppress
from pathlib import Path

from tests.faults.servers import await_port, free_port
from tests.storage.object_storage.moto_server import KEYS

PROGRAMS = ("ceph", "ceph-mon", "ceph-osd", "monmaptool", "radosgw", "radosgw-admin")
SETTINGS = """\
[global]
fsid = {fsid}
mon host = v2:127.0.0.1:{monitor}
public addr = 127.0.0.1
cluster addr = 127.0.0.1
ms bind ipv6 = false
ms mon client mode = crc
auth cluster required = none
auth service required = none
auth client required = none
mon allow pool size one = true
mon data avail warn = 1
mon data avail crit = 1
mon max pg per osd = 1000
osd pool default size = 1
osd pool default min size = 1
osd pool default pg num = 4
osd pool default pgp num = 4
osd objectstore = memstore
memstore device bytes = 2147483648
run dir = {folder}
admin socket = {folder}/$name.$pid.asok
log file = {folder}/$name.log
pid file = {folder}/$name.pid
keyring = {folder}/keyring
mon data = {folder}/mon
osd data = {folder}/osd
rgw data = {folder}/rgw
rgw frontends = beast endpoint=127.0.0.1:{gateway}
"""


def is_installed() -> bool:
    """Return whether Ceph's programs are there."""
    return all(map(shutil.which, PROGRAMS))


class Ceph:
    """A running cluster, whose gateway knows the keys of the tests."""

    def __init__(self, folder: Path):
        self.folder, self.port = folder, free_port()
        for name in ("mon", "osd", "rgw"):
            (folder / name).mkdir(parents=True)
        fsid, monitor = str(uuid.uuid4()), free_port()
        text = SETTINGS.format(fsid=fsid, folder=folder, monitor=monitor, gateway=self.port)
        (folder / "ceph.conf").write_text(text)
        self._environment = {**os.environ, "CEPH_CONF": str(folder / "ceph.conf")}
        try:
            self._start(fsid, monitor)
        except BaseException:
            self.stop()
            raise

    @property
    def url(self) -> str:
        """The gateway's address."""
        return f"http://127.0.0.1:{self.port}"

    def version(self) -> str:
        """Return Ceph's version."""
        return self._call("ceph", "--version").split(" (")[0]

    def restart_gateway(self) -> None:
        """Kill the gateway and start it again."""
        self._kill("client.admin")
        self._start_gateway()

    def stop(self) -> None:
        """Kill all of it."""
        for name in ("client.admin", "osd.0", "mon.a"):
            with suppress(OSError, ValueError):
                self._kill(name)

    def _start(self, fsid: str, monitor: int) -> None:
        map_file = self.folder / "monmap"
        address = f"[v2:127.0.0.1:{monitor}]"
        self._call("monmaptool", "--create", "--fsid", fsid, "--addv", "a", address, map_file)
        self._call("ceph-mon", "--mkfs", "-i", "a", "--monmap", map_file)
        self._call("ceph-mon", "-i", "a")
        number = self._call("ceph", "osd", "new", str(uuid.uuid4()))
        (found,) = json.loads(self._call("ceph", "osd", "dump", "-f", "json"))["osds"]
        self._call("ceph-osd", "-i", number, "--mkfs", "--osd-uuid", found["uuid"])
        self._call("ceph-osd", "-i", number)
        key, secret = KEYS["AWS_ACCESS_KEY_ID"], KEYS["AWS_SECRET_ACCESS_KEY"]
        new = ("user", "create", "--uid=league", "--display-name=league")
        self._call("radosgw-admin", *new, f"--access-key={key}", f"--secret={secret}")
        self._start_gateway()

    def _start_gateway(self) -> None:
        self._call("radosgw", "-n", "client.admin", "--no-mon-config")
        await_port(self.port)

    def _call(self, *command: object) -> str:
        """Return what a command prints; a daemon goes into the background. Raises RuntimeError if it fails."""
        with (self.folder / "calls.log").open("w+") as errors:  # a daemon keeps it open: a pipe would not end
            done = subprocess.run(
                [*map(str, command)], env=self._environment, stdout=subprocess.PIPE if command[0] != "radosgw" else
                errors, stderr=errors, text=True, timeout=120, check=False, start_new_session=True,
            )  # fmt: skip
            errors.seek(0)
            if done.returncode:
                raise RuntimeError(f"{command[0]} failed: {errors.read()[-1000:]}")
        return (done.stdout or "").strip()

    def _kill(self, name: str) -> None:
        pid = int((self.folder / f"{name}.pid").read_text())
        os.kill(pid, signal.SIGKILL)
        while Path(f"/proc/{pid}").exists():
            time.sleep(0.05)
