"""What a league stands on: a PostgreSQL server of our own, a line to it that can be cut, a small disk.

python benchmarks/servers.py 6543 5432      # hands on what comes to 127.0.0.1:6543 to 127.0.0.1:5432
"""

import asyncio
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path


def free_port() -> int:
    """A port of 127.0.0.1 on which nobody listens."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def programs() -> Path | None:
    """Where PostgreSQL's own programs are; None where it is not installed."""
    on_path = shutil.which("initdb")
    found = [Path(on_path)] if on_path else sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


class Server:
    """A PostgreSQL server of our own, which can be restarted without harm to anybody else's."""

    def __init__(self, folder: Path):
        bin = programs()
        assert bin is not None
        self.folder, self.port, self._ctl = folder, free_port(), bin / "pg_ctl"
        folder.mkdir(parents=True)
        self._as = []
        if os.getuid() == 0:  # it refuses to run as root
            shutil.chown(folder, "postgres")
            self._as = ["runuser", "-u", "postgres", "--"]
        self._run(bin / "initdb", "-D", folder / "data", "-U", "league", "-A", "trust", "--no-sync")
        self.start()

    def url(self, database: str, port: int | None = None) -> str:
        """Of one of its databases, made where it is not there; `port`: of a line to it."""
        url = f"postgresql://league@127.0.0.1:{self.port}/postgres"
        import psycopg

        with psycopg.connect(url, autocommit=True) as server:
            if not server.execute("SELECT 1 FROM pg_database WHERE datname = %s", [database]).fetchone():
                server.execute(f'CREATE DATABASE "{database}"')
        return f"postgresql://league@127.0.0.1:{port or self.port}/{database}"

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -k {self.folder} -c max_connections=200"
        self._run(self._ctl, "-D", self.folder / "data", "-w", "-l", self.folder / "log", "-o", options, "start")

    def stop(self, how: str = "immediate") -> None:
        """Stop it: `immediate` is a crash after which it recovers, `fast` cuts all connections."""
        self._run(self._ctl, "-D", self.folder / "data", "-m", how, "-w", "stop")

    def _run(self, *command: object) -> None:
        subprocess.run([*self._as, *map(str, command)], check=True, stdout=subprocess.DEVNULL, cwd="/")


class Line:
    """A line to a port: a process of ours that hands on bytes. Stopped, it swallows them; killed, it hangs up."""

    def __init__(self, to: int):
        self.port, self.to = free_port(), to
        self.mend()

    def mend(self) -> None:
        """Hand on bytes, from now on."""
        self.process = subprocess.Popen([sys.executable, __file__, str(self.port), str(self.to)])
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                return
            time.sleep(0.05)
        raise TimeoutError("the line does not answer")

    def silence(self) -> None:
        """Let nothing through and say nothing, as a pulled cable does."""
        self.process.send_signal(signal.SIGSTOP)

    def cut(self) -> None:
        """Hang up."""
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path]:
    """A disk of that size mounted on a folder. Raises CalledProcessError where that is not allowed."""
    folder.mkdir(parents=True, exist_ok=True)
    size = f"size={megabytes}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], check=True, capture_output=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


async def _hand_on(listening: int, to: int) -> None:
    async def pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            while data := await source.read(1 << 16):
                sink.write(data)
                await sink.drain()
        sink.close()

    async def joined(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            there, back = await asyncio.open_connection("127.0.0.1", to)
        except OSError:
            writer.close()
            return
        await asyncio.gather(pump(reader, back), pump(there, writer))

    server = await asyncio.start_server(joined, "127.0.0.1", listening)
    await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(_hand_on(int(sys.argv[1]), int(sys.argv[2])))
