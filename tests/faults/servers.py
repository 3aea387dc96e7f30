"""Infrastructure of a league under fault injection: PostgreSQL, a pooler, a line that can be cut, a small disk.

python -m tests.faults.servers 6543 5432 0.01   # forwards 127.0.0.1:6543 to 127.0.0.1:5432, 10 ms later
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


def await_port(port: int) -> None:
    """Wait until something listens on a port of 127.0.0.1."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return
        time.sleep(0.05)
    raise TimeoutError(f"nothing answers on port {port}")


def programs() -> Path | None:
    """Return the folder of PostgreSQL's programs; None if it is not installed."""
    on_path = shutil.which("initdb")
    found = [Path(on_path).resolve()] if on_path else sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    return found[-1].parent if found else None


def pooler() -> str | None:
    """Return the program of PgBouncer; None if it is not installed."""
    return shutil.which("pgbouncer") or shutil.which("/usr/sbin/pgbouncer")


def owner() -> list[str]:
    """Return the start of a command that runs as PostgreSQL's user: its programs refuse to run as root."""
    return ["runuser", "-u", "postgres", "--"] if os.getuid() == 0 else []


def owned(folder: Path) -> Path:
    """Make a folder that PostgreSQL's user may write to."""
    folder.mkdir(parents=True)
    if owner():
        shutil.chown(folder, "postgres")
    return folder


class Server:
    """A private PostgreSQL server, which can be restarted without affecting others; a standby of another one."""

    connections = 200  # from its next start

    def __init__(self, folder: Path, port: int | None = None, of: int | None = None):
        """Make it and start it; with `of`, as a standby of the server at that port."""
        bin = programs()
        assert bin is not None
        self.folder, self.port, self._ctl = owned(folder), port or free_port(), bin / "pg_ctl"
        data = folder / "data"
        if of is None:
            self._run(bin / "initdb", "-D", data, "-U", "league", "-A", "trust", "--no-sync")
        else:
            source = f"host=127.0.0.1 port={of} user=league application_name=standby"
            self._run(bin / "pg_basebackup", "-D", data, "-d", source, "-R", "-c", "fast", "--no-sync")
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
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -k {self.folder} -c max_connections={self.connections}"
        self._run(self._ctl, "-D", self.folder / "data", "-w", "-l", self.folder / "log", "-o", options, "start")

    def stop(self, how: str = "immediate") -> None:
        """Stop it: `immediate` is a crash after which it recovers, `fast` closes all connections."""
        self._run(self._ctl, "-D", self.folder / "data", "-m", how, "-w", "stop")

    def promote(self) -> None:
        """Make a standby take writes, and wait until it does."""
        self._run(self._ctl, "-D", self.folder / "data", "-w", "promote")

    def settle(self, **settings: str) -> None:
        """Change settings of the running server."""
        import psycopg

        with psycopg.connect(f"postgresql://league@127.0.0.1:{self.port}/postgres", autocommit=True) as server:
            for name, value in settings.items():
                server.execute(f"ALTER SYSTEM SET {name} = '{value}'")
            server.execute("SELECT pg_reload_conf()")

    def _run(self, *command: object) -> None:
        subprocess.run([*owner(), *map(str, command)], check=True, stdout=subprocess.DEVNULL, cwd="/")


class Pair:
    """A primary and its standby, which changes places with it in a failover."""

    def __init__(self, folder: Path, synchronous: bool):
        self._folder, self._synchronous, self._made = folder, synchronous, 0
        self.primary = Server(folder / "0")
        self._follow(None)

    def _follow(self, port: int | None) -> None:
        """Make a standby of the primary, connected by a line."""
        self._made += 1
        self._line = Line(self.primary.port)
        try:
            self.standby = Server(self._folder / str(self._made), port, self._line.port)
        except BaseException:
            self._line.cut()
            raise
        if self._synchronous:
            self.primary.settle(synchronous_standby_names="standby")

    def fall_behind(self, seconds: float) -> None:
        """Let the standby hear nothing, and wait."""
        self._line.silence()
        time.sleep(seconds)

    def fail_over(self) -> None:
        """Crash the primary, and promote the standby."""
        self.primary.stop("immediate")
        self._line.cut()
        self.standby.promote()
        shutil.rmtree(self.primary.folder)
        port, self.primary = self.primary.port, self.standby
        self._follow(port)

    def stop(self) -> None:
        """Stop both."""
        self._line.cut()
        self.standby.stop()
        self.primary.stop()


class Bouncer:
    """PgBouncer before a server, with few sessions that all clients share."""

    def __init__(self, folder: Path, to: int, mode: str = "transaction", **settings: str):
        program = pooler()
        assert program is not None
        self.folder, self.port, self._mode, self._settings = owned(folder), free_port(), mode, settings
        self.direct(to)
        self._log = (folder / "log").open("ab")
        command = [*owner(), program, "-q", str(folder / "pgbouncer.ini")]
        self.process = subprocess.Popen(command, stdout=self._log, stderr=self._log, cwd="/", start_new_session=True)
        await_port(self.port)

    def direct(self, to: int) -> None:
        """Write its settings, with the server's port; a running pooler reads them by `reload`."""
        lines = {
            "listen_addr": "127.0.0.1", "listen_port": self.port, "unix_socket_dir": "", "auth_type": "any",
            "pool_mode": self._mode, "default_pool_size": 8, "max_client_conn": 500, "server_login_retry": 1,
            "admin_users": "league", **self._settings,
        }  # fmt: skip
        text = "\n".join(f"{name} = {value}" for name, value in lines.items())
        databases = f"[databases]\n* = host=127.0.0.1 port={to} user=league"
        (self.folder / "pgbouncer.ini").write_text(f"{databases}\n[pgbouncer]\n{text}\n")

    def reload(self, to: int) -> None:
        """Let it use another server."""
        import psycopg

        self.direct(to)
        url = f"postgresql://league@127.0.0.1:{self.port}/pgbouncer"
        with psycopg.connect(
            url, autocommit=True, prepare_threshold=None, cursor_factory=psycopg.ClientCursor
        ) as admin:
            admin.execute("RELOAD")

    def stop(self) -> None:
        """Kill it."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()
        self._log.close()


class Line:
    """A network line to a port: a process that forwards bytes. Stopped, it drops them; killed, it disconnects."""

    def __init__(self, to: int, delay: float = 0.0):
        """Start forwarding; bytes take `delay` seconds in each direction."""
        self.port, self.to, self.delay = free_port(), to, delay
        self.mend()

    def mend(self) -> None:
        """Start forwarding bytes."""
        self.process = subprocess.Popen([sys.executable, __file__, str(self.port), str(self.to), str(self.delay)])
        await_port(self.port)

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


async def _forward(listening: int, to: int, delay: float = 0.0) -> None:
    async def pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        on_the_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue()

        async def arrive() -> None:
            while (found := await on_the_way.get())[1]:
                await asyncio.sleep(found[0] - loop.time())
                sink.write(found[1])
                await sink.drain()

        with contextlib.suppress(OSError):
            arriving = asyncio.create_task(arrive())
            while data := await source.read(1 << 16):
                if arriving.done():
                    break
                on_the_way.put_nowait((loop.time() + delay, data))
            on_the_way.put_nowait((0.0, b""))
            await arriving
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
    asyncio.run(_forward(int(sys.argv[1]), int(sys.argv[2]), *map(float, sys.argv[3:])))
