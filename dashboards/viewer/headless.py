"""Rerun's viewer without a window: its process, its temporary files, and the reasons for a missing picture."""

import fcntl
import io
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any, TypeVar

from dashboards.errors import ViewerError

NO_DRIVER = "a picture needs a graphics driver (Vulkan); on Debian or Ubuntu: apt-get install mesa-vulkan-drivers"
NO_WINDOW = "rerun's window did not open here; it needs a display and a graphics driver"
STABLE_PICTURES = 3  # equal pictures in a row; two are too few for a viewer that gets a tenth of a processor
PATIENCE = 180.0  # s, limit for a picture, which takes two to three on an idle machine
HIDDEN = 20.0  # s after which a window that runs and draws nothing is taken for a hidden one
TITLE_BAR = 36  # pixels, empty even where the viewer's top panel is hidden
LOCAL = "127.0.0.1"
"""Every listener's address, unreachable from other machines. Rerun's own default is 0.0.0.0, all addresses."""
WINDOWS: list[subprocess.Popen[bytes]] = []
"""Windows that this process has opened; referenced here, since Python warns of an unreferenced running process."""
FOLDER, LOG = "robot-league-viewer-", "viewer.log"

# Code of the viewer's process before it becomes the viewer: the kernel then ends it when this process ends.
LAUNCH = """
import ctypes, os, signal, sys
starter, *command = sys.argv[1:]
if sys.platform == "linux":
    PR_SET_PDEATHSIG = 1
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
if os.getppid() == int(starter):
    os.execv(command[0], command)
"""

Answer = TypeVar("Answer")


class HeadlessViewer:
    """A running viewer and its folder, whose files end with it."""

    def __init__(self, process: subprocess.Popen[bytes], log: IO[bytes], port: int, size: tuple[int, int]):
        """Wait until the viewer answers on the port; it writes to `log` and draws pictures of `size` pixels."""
        from rerun.experimental import ViewerClient

        self.folder = Path(log.name).parent
        self.process, self._log, self._size = process, log, size
        self._started = time.monotonic()
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"
        self._client = self._ask(lambda: ViewerClient.connect(self.url))
        self._ask(self._client.take_screenshot)  # without a driver it answers other requests before it ends

    def state(self) -> Any:
        """Return the viewer's own description of its recordings and views, a `rerun.experimental.ViewerState`."""
        return self._ask(self._client.get_state)

    def open(self, what: str) -> None:
        """Load a file, or follow the address of a hub."""
        self._ask(lambda: self._client.open(what))

    def picture(self, rrd: Path, timeline: str, seconds: float) -> bytes:
        """Return a PNG of a file at a moment of one of its timelines.

        The viewer loads while it draws, and its first pictures may show a message bubble.
        """
        self.open(str(rrd))
        self._ask(lambda: self._client.set_time(timeline, duration=seconds, play_state="paused"))
        last: list[bytes] = []
        while len(last) < STABLE_PICTURES:
            time.sleep(0.4)
            picture = self._ask(self._client.take_screenshot)
            last = [*last, picture] if picture in last[:1] and not self.state().loading else [picture]
        return self._without_title_bar(last[-1])

    def _without_title_bar(self, picture: bytes) -> bytes:
        from PIL import Image

        out = io.BytesIO()
        with Image.open(io.BytesIO(picture)) as image:
            image.crop((0, TITLE_BAR, self._size[0], self._size[1] + TITLE_BAR)).save(out, format="PNG")
        return out.getvalue()

    def _ask(self, call: Callable[[], Answer]) -> Answer:
        """Return the viewer's answer once it has started and loaded. Raises ViewerError with the reason if it has
        ended.
        """
        while True:
            try:
                return call()
            except (OSError, RuntimeError, ValueError) as error:  # rerun's errors while there is no answer
                if self.process.poll() is not None:
                    why = _why_no_picture(self.process.returncode, self._log)
                    if time.monotonic() - self._started >= PATIENCE:
                        why = f"there was no picture within {PATIENCE:g} s; is this machine very busy?"
                    raise ViewerError(why) from error
            time.sleep(0.1)


@contextmanager
def headless_viewer(size: tuple[int, int]) -> Iterator[HeadlessViewer]:
    """Yield a viewer that ends with the block, or with this process. Raises ViewerError where none can run.

    It is not started by `ViewerClient.spawn`, which cannot set the size of the picture and hides the reason of a
    failure.
    """
    with viewer_log() as log:
        port = free_port()
        window = f"{size[0]}x{size[1] + TITLE_BAR}"
        process = start_rerun(log, "--headless", "--window-size", window, "--port", str(port), "--hide-welcome-screen")
        patience = threading.Timer(PATIENCE, process.kill)  # a call to a hanging viewer would never return
        patience.start()
        try:
            yield HeadlessViewer(process, log, port, size)
        finally:
            patience.cancel()
            process.kill()
            process.wait()


def start_rerun(log: IO[bytes], *options: str) -> subprocess.Popen[bytes]:
    """Start rerun's own program: it ends with this process, listens to this machine alone, and writes to `log`."""
    folder = os.path.dirname(log.name)
    local = ("--host", LOCAL) if options[:1] == ("server",) else ("--bind", LOCAL)
    environment = {
        "RERUN_APP_ONLY": "true",
        "RUST_LOG": "error",
        "TMPDIR": folder,
    }  # lesser messages would appear as bubbles
    return subprocess.Popen(
        [sys.executable, "-I", "-c", LAUNCH, str(os.getpid()), executable(), *options, *local],
        env=os.environ | environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,  # this process alone handles Ctrl-C
    )


def start_window(*options: str) -> subprocess.Popen[bytes]:
    """Start rerun's own program with a window, which outlives this process. It listens to this machine alone."""
    process = subprocess.Popen(
        [executable(), *options, "--bind", LOCAL],
        env=os.environ | {"RERUN_APP_ONLY": "true"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    WINDOWS.append(process)
    return process


def open_window(port: int, otherwise: str) -> None:
    """Ensure that a viewer listens on a port: a running one, or a new window. Raises ViewerError where none opens, with
    what to use otherwise.
    """
    process, began = None, time.monotonic()
    while True:
        with suppress(OSError), socket.create_connection((LOCAL, port), timeout=1):
            break
        if process is None:
            process = start_window("--port", str(port), "--hide-welcome-screen", "--expect-data-soon")
        elif process.poll() is not None or time.monotonic() - began > PATIENCE:
            process.kill()
            raise ViewerError(f"{NO_WINDOW}; use {otherwise}")
        time.sleep(0.1)
    if process is not None and not _draws(process, port):
        raise ViewerError(f"{NO_WINDOW}; use {otherwise}")


def _draws(process: subprocess.Popen[bytes], port: int) -> bool:
    """Return False where a new window ends before its first picture: without a graphics driver it listens before."""
    from rerun.experimental import ViewerClient

    drawn = threading.Event()

    def wait_for_a_picture() -> None:
        with suppress(OSError, RuntimeError, ValueError):  # rerun's errors where the window ends
            ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy").take_screenshot()
            drawn.set()

    threading.Thread(target=wait_for_a_picture, daemon=True).start()
    began = time.monotonic()
    while not drawn.wait(0.1) and time.monotonic() - began < HIDDEN:
        if process.poll() is not None:
            return False
    return True


def executable() -> str:
    """Return the viewer's binary: the `rerun` command is a Python program whose child, the viewer, outlives it."""
    import rerun_cli

    return os.environ.get("RERUN_CLI_PATH") or str(Path(str(rerun_cli.__file__)).with_name("rerun"))


@contextmanager
def viewer_log() -> Iterator[IO[bytes]]:
    """Yield a log in a folder of its own, which is removed at the end of the block."""
    remove_abandoned_folders()
    with tempfile.TemporaryDirectory(prefix=FOLDER, ignore_cleanup_errors=True) as folder, _locked_log(folder) as log:
        yield log


def wait_until_it_listens(process: subprocess.Popen[bytes], log: IO[bytes], port: int) -> None:
    """Return when a process answers on a port. Raises ViewerError where `process` ends or takes too long."""
    began = time.monotonic()
    while True:
        with suppress(OSError), socket.create_connection((LOCAL, port), timeout=1):
            return
        if process.poll() is not None:
            raise ViewerError(_why_no_picture(process.returncode, log))
        if time.monotonic() - began > PATIENCE:
            raise ViewerError(f"rerun did not answer on port {port} within {PATIENCE:g} s; is this machine very busy?")
        time.sleep(0.1)


def free_port() -> int:
    """Return a port of this machine on which no process listens now."""
    with socket.create_server((LOCAL, 0)) as free:
        return free.getsockname()[1]


@contextmanager
def _locked_log(folder: str) -> Iterator[IO[bytes]]:
    """Yield the viewer's log, locked for as long as this process or the viewer has it open."""
    new, log = Path(folder, "viewer.new"), Path(folder, LOG)
    new.touch()
    with new.open("r+b") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        new.rename(log)  # from now on other processes may find it
        yield locked


def remove_abandoned_folders() -> None:
    """Remove the folders whose log is unlocked: they were left by killed processes."""
    for log in Path(tempfile.gettempdir()).glob(f"{FOLDER}*/{LOG}"):
        with suppress(OSError), log.open("rb") as unlocked:
            fcntl.flock(unlocked, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(log.parent, ignore_errors=True)


def _why_no_picture(status: int, log: IO[bytes]) -> str:
    log.seek(0)
    text = log.read().decode(errors="replace")
    if any(sign in text for sign in ("adapter", "render context", "render state", "Vulkan")):
        return NO_DRIVER
    if status < 0:
        return f"rerun's viewer was ended by {signal.Signals(-status).name}; is this machine short of memory?"
    lines = text.strip().splitlines() or ["it said nothing"]
    panics = [line for line in lines if "panicked at" in line]
    return f"rerun's viewer did not start: {[*lines[-1:], *panics][-1]}"
