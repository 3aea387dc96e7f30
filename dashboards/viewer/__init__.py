"""Drawing of a recorded match with rerun. Only this package imports rerun, and only when it is used.

The picture is made from the recorded joint positions on demand; a `.rrd` file is a disposable view of a recording.
"""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from dashboards.errors import ViewerError
from dashboards.identity import MatchPlayer
from dashboards.replay import Replay, replay
from dashboards.system.outputs import PICTURES, RERUN, new_output, write_durably
from dashboards.system.ports import listen, next_port
from dashboards.viewer.headless import (
    LOCAL,
    NO_WINDOW,
    free_port,
    headless_viewer,
    open_window,
    start_rerun,
    viewer_log,
    wait_until_it_listens,
)
from dashboards.viewer.panels import blueprint, draw_panels
from dashboards.viewer.scene import draw_scene
from storage.recordings.recording import Recording

OTHERWISE = "--web for a browser on this machine, --save match.rrd for a file or --shot match.png for a picture"
Players = Sequence[MatchPlayer] | None
"""The players by side; None if only their names are known."""


def write_rrd(recording: Recording, path: str | Path, players: Players = None) -> None:
    """Write the match as a rerun file.

    Raises ViewerError where rerun is not installed or the name is not *.rrd, StorageError where it cannot be written.
    """
    rr = _rerun()
    scene = replay(recording, players)
    with new_output(path, RERUN) as partial:
        write_durably(partial, _encoded(rr, recording, scene))


def require_display(otherwise: str = OTHERWISE) -> None:
    """Raise ViewerError where no window can open, with an alternative."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(f"there is no display here; use {otherwise}")


def show(recording: Recording, players: Players = None, port: int = 9876) -> None:
    """Open the match in rerun's window; a viewer that already listens on the port gets it as an additional recording.

    The window listens on 127.0.0.1 alone. `rerun.spawn` is not used: its viewer listens on every address.

    Raises ViewerError where there is no display, no window opens or rerun is not installed.
    """
    rr = _rerun()
    require_display()
    scene = replay(recording, players)
    stream = _stream(rr, recording)
    open_window(port, OTHERWISE)
    stream.connect_grpc(f"rerun+http://{LOCAL}:{port}/proxy", default_blueprint=blueprint(rr, recording, scene))
    _draw(rr, stream, recording, scene)
    _deliver(stream, f"{NO_WINDOW}; use {OTHERWISE}")


def screenshot(
    recording: Recording,
    path: str | Path,
    at_seconds: float,
    size: tuple[int, int] = (1600, 1000),
    players: Players = None,
) -> None:
    """Write a picture of `size` pixels of the match at a moment, without a display.

    Raises ViewerError where the moment is outside the match, the name has no suffix of a picture, or rerun or a Vulkan
    driver is not installed; StorageError where it cannot be written.
    """
    rr = _rerun()
    first, last, dt = recording.time[0], recording.time[-1], recording.header.dt
    if not first - dt <= at_seconds <= last + dt:  # accepts rounded ends: 0, or 2 for 1.9999
        raise ViewerError(f"there is no second {at_seconds:g} in this match; it has {first:g} to {last:g}")
    with new_output(path, PICTURES) as partial, headless_viewer(size) as viewer:
        rrd = viewer.folder / "match.rrd"
        write_durably(rrd, _encoded(rr, recording, replay(recording, players), panels=False))
        _save_as(viewer.picture(rrd, "sim_time", float(np.clip(at_seconds, first, last))), partial)


def _save_as(png: bytes, path: Path) -> None:
    """Write a picture in the format of its name's suffix."""
    if path.suffix == ".png":
        path.write_bytes(png)
        return
    from PIL import Image

    with Image.open(BytesIO(png)) as picture:
        picture.convert("RGB").save(path)


@contextmanager
def hub(port: int) -> Iterator["Hub"]:
    """Run rerun's viewer as a page on 127.0.0.1 and yield a Hub that sends it matches; late viewers see all of them.

    The page reads the matches from the next port, which a person who forwards ports must forward too.

    Raises ViewerError where the port is taken or rerun is not installed.
    """
    _rerun()
    listen(port).close()
    with viewer_log() as log:
        feed = next_port(port)
        process = start_rerun(log, "--serve-web", "--web-viewer-port", str(port), "--port", str(feed))
        try:
            wait_until_it_listens(process, log, port)
            yield Hub(port, f"rerun+http://127.0.0.1:{feed}/proxy")
        finally:
            process.kill()
            process.wait()


@contextmanager
def web_viewer(port: int) -> Iterator[tuple[str, Callable[[], bool]]]:
    """Run rerun's viewer as a page on 127.0.0.1, at this port, that draws the file in its address; yield its origin and
    a check that it runs.

    Raises ViewerError where rerun is not installed or does not start.
    """
    _rerun()
    with viewer_log() as log:
        process = start_rerun(log, "--serve-web", "--web-viewer-port", str(port), "--port", str(free_port()))
        try:
            wait_until_it_listens(process, log, port)
            yield f"http://127.0.0.1:{port}", lambda: process.poll() is None
        finally:
            process.kill()
            process.wait()


@contextmanager
def catalog(files: Path, port: int | None) -> Iterator[str]:
    """Serve rerun's table of all matches in a folder; yield its address: for a browser, or without a port for rerun's
    window.
    """
    _rerun()
    if port is not None:
        listen(port).close()
    with viewer_log() as log, viewer_log() as page_log:
        feed = free_port() if port is None else next_port(port)
        processes = [start_rerun(log, "server", "-d", f"league={files}", "--port", str(feed))]
        try:
            wait_until_it_listens(processes[0], log, feed)
            url = f"rerun+http://127.0.0.1:{feed}"
            if port is not None:
                processes.append(start_rerun(page_log, "--serve-web", "--web-viewer-port", str(port), url))
                wait_until_it_listens(processes[1], page_log, port)
            yield url if port is None else f"http://127.0.0.1:{port}/?url={quote(url, safe='')}&theme=dark"
        finally:
            for process in processes:
                process.kill()
                process.wait()


@dataclass(frozen=True)
class Hub:
    """The addresses to which matches are sent and at which they are seen."""

    port: int
    feed: str

    @property
    def address(self) -> str:
        """The address for a browser of this machine."""
        return f"http://127.0.0.1:{self.port}/?url={quote(self.feed, safe='')}&theme=dark&hide_welcome_screen"

    def send(self, recording: Recording, players: Players = None) -> None:
        """Show a match as an additional recording, the active one. Raises ViewerError where the hub has ended."""
        rr = _rerun()
        scene, stream = replay(recording, players), _stream(rr, recording)
        stream.connect_grpc(self.feed, default_blueprint=blueprint(rr, recording, scene))
        _draw(rr, stream, recording, scene)
        _deliver(stream, "the web viewer has ended; start it again")


def _deliver(stream: Any, otherwise: str) -> None:
    try:
        stream.flush(timeout_sec=30.0)
    except RuntimeError as error:
        raise ViewerError(otherwise) from error
    stream.disconnect()


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise ViewerError("watching a match needs rerun; install it with: pip install 'robot-league[view]'") from error
    return rerun


def _stream(rr: Any, recording: Recording) -> Any:
    header = recording.header
    name = f"{header.league}-{header.match}-{header.seed}-{header.world}"
    return rr.RecordingStream("robot-league", recording_id=name)


def _encoded(rr: Any, recording: Recording, scene: Replay, panels: bool = True) -> bytes:
    """Return a match as the bytes of a rerun file.

    Rerun's own file writer silently drops data on a full disk, and may block forever.
    """
    stream = _stream(rr, recording)
    encoded = stream.binary_stream()
    stream.send_blueprint(blueprint(rr, recording, scene, panels), make_active=False, make_default=True)
    _draw(rr, stream, recording, scene)
    data = encoded.read()
    stream.disconnect()
    return data


def _draw(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    header = recording.header
    stream.send_recording_name(f"{' – '.join(header.sides)}: {header.outcome}")
    about = {f"side_{i}": side for i, side in enumerate(header.sides)} | {
        f"rating_{i}": player.rating for i, player in enumerate(scene.players)
    }
    about |= {"outcome": header.outcome, "arena": header.arena.arena, "seconds": float(recording.time[-1])}
    stream.send_property("match", rr.AnyValues(**about))  # columns of the table of many matches
    draw_scene(rr, stream, recording, scene)
    draw_panels(rr, stream, recording, scene)
