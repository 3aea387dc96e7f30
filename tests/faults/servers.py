"""Infrastructure of a league under fault injection: a PostgreSQL server, a network line that can be cut, a small disk.

python -m tests.faults.servers 6543 5432      # forwards 127.0.0.1:6543 to 127.0.0.1:5432
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
    """Return an unused port of 127.0.0.1."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def programs() -> Path | None:
    """Return the folder of PostgreSQL's programs; None if it is not installed."""
    on_path = shutil.which("initdb")
    found = [Path(on_path)] if on_path else sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


class Server:
    """A private PostgreSQL server, which can be restarted without affecting others."""

    def __init__(self, folder: Path):
        bin = programs()
        assert bin is not None
        self.folder, self.port, self._ctl = folder, free_port(), bin / "pg_ctl"
        folder.mkdir(parents=True)
        self._as = []
        if os.getuid() == 0:  # PostgreSQL refuses to run as root
            shutil.chown(folder, "postgres")
            self._as = ["runuser", "-u", "postgres", "--"]
        self._run(bin / "initdb", "-D", folder / "data", "-U", "league", "-A", "trust", "--no-sync")
        self.start()

    def url(self, database: str, port: int | None = None) -> str:
        """Return the URL of one of its databases, created if it is missing; `port` is that of a line to the server."""
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
        """Stop it: `immediate` is a crash after which it recovers, `fast` closes all connections."""
        self._run(self._ctl, "-D", self.folder / "data", "-m", how, "-w", "stop")

    def _run(self, *command: object) -> None:
        subprocess.run([*self._as, *map(str, command)], check=True, stdout=subprocess.DEVNULL, cwd="/")


class Line:
    """A network line to a port: a process that forwards bytes. Stopped, it drops them; killed, it disconnects."""

    def __init__(self, to: int):
        self.port, self.to = free_port(), to
        self.mend()

    def mend(self) -> None:
        """Start forwarding bytes."""
        self.process = subprocess.Popen([sys.executable, __file__, str(self.port), str(self.to)])
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                return
            time.sleep(0.05)
        raise TimeoutError("the line does not answer")

    def silence(self) -> None:
        """Forward nothing and stay silent, as a pulled cable does."""
        self.process.send_signal(signal.SIGSTOP)

    def cut(self) -> None:
        """Disconnect."""
        self.process.kill()
        self.process.wait()


@contextlib.contextmanager
def small_disk(folder: Path, megabytes: int) -> Iterator[Path]:
    """Mount a disk of this size on a folder. Raises CalledProcessError if that is not permitted."""
    folder.mkdir(parents=True, exist_ok=True)
    size = f"size={megabytes}m"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], check=True, capture_output=True)
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


async def _forward(listening: int, to: int) -> None:
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
    asyncio.run(_forward(int(sys.argv[1]), int(sys.argv[2])))
