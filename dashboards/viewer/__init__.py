"""Draws a recorded match with rerun: only this package and `dashboards.headless` call it, and only when it is used.

The picture is made from the recorded joint positions on demand; a `.rrd` file is a throw-away view of a recording.
"""

import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dashboards.cast import Performer
from dashboards.errors import ViewerError
from dashboards.headless import headless_viewer
from dashboards.replay import Replay, replay
from dashboards.viewer.panels import blueprint, draw_panels
from dashboards.viewer.scene import draw_scene
from storage.recording import Recording

NO_WINDOW = "--save match.rrd for a file or --shot match.png for a picture"
Cast = Sequence[Performer] | None
"""Who plays, by side; None: nothing but their names is known."""


def write_rrd(recording: Recording, path: str | Path, cast: Cast = None) -> None:
    """Write the match as a rerun file. Raises ViewerError where rerun is not installed."""
    rr = _rerun()
    scene = replay(recording, cast)
    stream = _stream(rr, recording)
    stream.save(path, default_blueprint=blueprint(rr, recording, scene))
    _draw(rr, stream, recording, scene)
    stream.disconnect()


def show(recording: Recording, cast: Cast = None, port: int = 9876) -> None:
    """Open the match in rerun's window; a viewer that already listens on the port gets it as one more recording.

    Raises ViewerError where there is no display, no window opens or rerun is not installed.
    """
    rr = _rerun()
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(f"there is no display here; use {NO_WINDOW}")
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
    try:
        stream.flush(timeout_sec=30.0)
    except RuntimeError as error:
        raise ViewerError(f"rerun's window did not open here; use {NO_WINDOW}") from error
    stream.disconnect()


def shot(
    recording: Recording, path: str | Path, at_seconds: float, size: tuple[int, int] = (1600, 1000), cast: Cast = None
) -> None:
    """Write a PNG of `size` pixels of the match at a moment, without a display.

    Raises ViewerError where the match does not have that moment, or rerun or a Vulkan driver is not installed.
    """
    rr = _rerun()
    first, last, dt = recording.time[0], recording.time[-1], recording.header.dt
    if not first - dt <= at_seconds <= last + dt:  # the ends as a person writes them: 0, or 2 for 1.9999
        raise ViewerError(f"there is no second {at_seconds:g} in this match; it has {first:g} to {last:g}")
    with headless_viewer(size) as viewer:
        rrd = viewer.folder / "match.rrd"
        stream, scene = _stream(rr, recording), replay(recording, cast)
        stream.save(rrd, default_blueprint=blueprint(rr, recording, scene, panels=False))
        _draw(rr, stream, recording, scene)
        stream.disconnect()
        picture = viewer.picture(rrd, "sim_time", float(np.clip(at_seconds, first, last)))
    Path(path).write_bytes(picture)


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
    draw_scene(rr, stream, recording, scene)
    draw_panels(rr, stream, recording, scene)
