"""Draws a recorded match with rerun: only this package and `dashboards.headless` call it, and only when it is used.

The picture is made from the recorded joint positions on demand; a `.rrd` file is a throw-away view of a recording.
"""

import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from dashboards.cast import Performer
from dashboards.errors import ViewerError
from dashboards.headless import free_port, headless_viewer, logged, start, wait_until_it_listens
from dashboards.outputs import PICTURES, RERUN, output
from dashboards.replay import Replay, replay
from dashboards.server import bound
from dashboards.viewer.panels import blueprint, draw_panels
from dashboards.viewer.scene import draw_scene
from storage.recording import Recording

NO_WINDOW = "--web for a browser on this machine, --save match.rrd for a file or --shot match.png for a picture"
Cast = Sequence[Performer] | None
"""Who plays, by side; None: nothing but their names is known."""


def write_rrd(recording: Recording, path: str | Path, cast: Cast = None) -> None:
    """Write the match as a rerun file.

    Raises ViewerError where rerun is not installed or the name is not *.rrd, StorageError where it cannot be written.
    """
    rr = _rerun()
    scene = replay(recording, cast)
    with output(path, RERUN) as partial:
        stream = _stream(rr, recording)
        try:
            stream.save(partial, default_blueprint=blueprint(rr, recording, scene))
            _draw(rr, stream, recording, scene)
            stream.disconnect()
        except RuntimeError as error:  # a full disk, as rerun tells it
            raise ViewerError(f"rerun could not write {path}: {str(error).splitlines()[0]}") from error


def require_display(otherwise: str = NO_WINDOW) -> None:
    """Raise ViewerError where no window can open, with what to use instead."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(f"there is no display here; use {otherwise}")


def show(recording: Recording, cast: Cast = None, port: int = 9876) -> None:
    """Open the match in rerun's window; a viewer that already listens on the port gets it as one more recording.

    Raises ViewerError where there is no display, no window opens or rerun is not installed.
    """
    rr = _rerun()
    require_display()
    scene = replay(recording, cast)
    stream = _stream(rr, recording)
    rr.spawn(
        port=port,
        hide_welcome_screen=True,
        executable_path=shutil.which("rerun", path=str(Path(sys.executable).parent)),
        default_blueprint=blueprint(rr, recording, scene),
        recording=stream,
    )
    _draw(rr, stream, recording, scene)
    _deliver(stream, f"rerun's window did not open here; use {NO_WINDOW}")


def shot(
    recording: Recording, path: str | Path, at_seconds: float, size: tuple[int, int] = (1600, 1000), cast: Cast = None
) -> None:
    """Write a picture of `size` pixels of the match at a moment, without a display.

    Raises ViewerError where the match does not have that moment, the name does not end as a picture's does, or rerun or
    a Vulkan driver is not installed; StorageError where it cannot be written.
    """
    rr = _rerun()
    first, last, dt = recording.time[0], recording.time[-1], recording.header.dt
    if not first - dt <= at_seconds <= last + dt:  # the ends as a person writes them: 0, or 2 for 1.9999
        raise ViewerError(f"there is no second {at_seconds:g} in this match; it has {first:g} to {last:g}")
    with output(path, PICTURES) as partial, headless_viewer(size) as viewer:
        rrd = viewer.folder / "match.rrd"
        stream, scene = _stream(rr, recording), replay(recording, cast)
        stream.save(rrd, default_blueprint=blueprint(rr, recording, scene, panels=False))
        _draw(rr, stream, recording, scene)
        stream.disconnect()
        _keep(viewer.picture(rrd, "sim_time", float(np.clip(at_seconds, first, last))), partial)


def _keep(png: bytes, path: Path) -> None:
    """Write a picture as the kind that its name says."""
    if path.suffix == ".png":
        path.write_bytes(png)
        return
    from PIL import Image

    with Image.open(BytesIO(png)) as picture:
        picture.convert("RGB").save(path)


@contextmanager
def hub(port: int) -> Iterator["Hub"]:
    """Rerun's viewer as a page on 127.0.0.1, and what is sent to it: whoever opens it late sees all of that.

    Raises ViewerError where the port is taken or rerun is not installed.
    """
    _rerun()
    bound(port).close()
    with logged() as log:
        feed = free_port()
        process = start(log, "--serve-web", "--web-viewer-port", str(port), "--port", str(feed))
        try:
            wait_until_it_listens(process, log, port)
            yield Hub(port, f"rerun+http://127.0.0.1:{feed}/proxy")
        finally:
            process.kill()
            process.wait()


@contextmanager
def web_viewer() -> Iterator[tuple[str, Callable[[], bool]]]:
    """Rerun's viewer as a page on 127.0.0.1 that draws the file its address names; its origin, and whether it is there.

    Raises ViewerError where rerun is not installed or does not start.
    """
    _rerun()
    with logged() as log:
        port = free_port()
        process = start(log, "--serve-web", "--web-viewer-port", str(port), "--port", str(free_port()))
        try:
            wait_until_it_listens(process, log, port)
            yield f"http://127.0.0.1:{port}", lambda: process.poll() is None
        finally:
            process.kill()
            process.wait()


@contextmanager
def catalog(files: Path, port: int | None) -> Iterator[str]:
    """Rerun's table of all matches in a folder; its address: for a browser, or without a port for rerun's window."""
    _rerun()
    if port is not None:
        bound(port).close()
    with logged() as log, logged() as page_log:
        feed = free_port()
        processes = [start(log, "server", "-d", f"league={files}", "--port", str(feed))]
        try:
            wait_until_it_listens(processes[0], log, feed)
            url = f"rerun+http://127.0.0.1:{feed}"
            if port is not None:
                processes.append(start(page_log, "--serve-web", "--web-viewer-port", str(port), url))
                wait_until_it_listens(processes[1], page_log, port)
            yield url if port is None else f"http://127.0.0.1:{port}/?url={quote(url, safe='')}&theme=dark"
        finally:
            for process in processes:
                process.kill()
                process.wait()


@dataclass(frozen=True)
class Hub:
    """Where matches are sent to, and where they are seen."""

    port: int
    feed: str

    @property
    def address(self) -> str:
        """For a browser of this machine."""
        return f"http://127.0.0.1:{self.port}/?url={quote(self.feed, safe='')}&theme=dark&hide_welcome_screen"

    def send(self, recording: Recording, cast: Cast = None) -> None:
        """Show a match as one more recording, the active one. Raises ViewerError where the hub is gone."""
        rr = _rerun()
        scene, stream = replay(recording, cast), _stream(rr, recording)
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


def _draw(rr: Any, stream: Any, recording: Recording, scene: Replay) -> None:
    header = recording.header
    stream.send_recording_name(f"{' – '.join(header.sides)}: {header.outcome}")
    about = {f"side_{i}": side for i, side in enumerate(header.sides)} | {
        f"rating_{i}": who.rating for i, who in enumerate(scene.cast)
    }
    about |= {"outcome": header.outcome, "arena": header.arena.arena, "seconds": float(recording.time[-1])}
    stream.send_property("match", rr.AnyValues(**about))  # columns of the table of many matches
    draw_scene(rr, stream, recording, scene)
    draw_panels(rr, stream, recording, scene)
