"""Output of a recording as a command's options ask: a window, a browser, a file for rerun, a picture or a film."""

import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from dashboards.errors import ViewerError
from dashboards.identity import MatchPlayer
from dashboards.system.outputs import FILMS, PICTURES, RERUN, require_output
from league.commands.progress_bar import Progress
from storage.recordings.recording import Recording

PICTURE, FILM = (1600, 1000), (960, 600)  # pixels


@dataclass(frozen=True)
class ViewOptions:
    """The way in which a match is shown or written."""

    save: Path | None = None
    """Write a file that `rerun` opens."""
    shot: Path | None = None
    """Write a picture; needs no display."""
    at: float | None = None
    """The picture's moment in seconds (default: two thirds into the match), or the film's first."""
    video: Path | None = None
    """Write a film, out.mp4, out.webm, out.gif or out.webp; needs no display and no graphics driver."""
    seconds: float | None = field(default=None, metadata={"above": 0.0})
    """Length of the film (default: to the end of the match)."""
    rate: int = field(default=20, metadata={"low": 1, "high": 50})
    """The film's pictures per second."""
    web: bool = False
    """In a browser on this machine instead of a window."""
    port: int = field(default=9090, metadata={"low": 1, "high": 65534})
    """Port of the viewer in a browser, at 127.0.0.1."""

    @property
    def writes(self) -> bool:
        """True if the match is written to files instead of being shown."""
        return bool(self.save or self.shot or self.video)

    def require_outputs(self) -> None:
        """Raise ViewerError, one line, for a file that cannot be written."""
        for path, kinds in ((self.save, RERUN), (self.shot, PICTURES), (self.video, FILMS)):
            if path is not None:
                require_output(path, kinds)


def view(options: ViewOptions, recording: Recording, who: Sequence[MatchPlayer]) -> None:
    """Write the files that the options name, or show the recording if they name none."""
    if not options.writes:
        _show(options, recording, who)
        return
    from dashboards import viewer

    if options.save is not None:
        viewer.write_rrd(recording, options.save, who)
        print(f"Wrote {options.save}; `rerun {options.save}` opens it.")
    if options.shot is not None:
        _shoot(options, recording, who)
    if options.video is not None:
        _film(options, recording, who)


def _show(options: ViewOptions, recording: Recording, who: Sequence[MatchPlayer]) -> None:
    """Show a recording in a window, or in a browser until Ctrl-C."""
    from dashboards import viewer

    if not options.web:
        viewer.show(recording, who)
        return
    with suppress(KeyboardInterrupt), viewer.hub(options.port) as hub:
        hub.send(recording, who)
        print(f"{hub.address}\nshows it in a browser on this machine; Ctrl-C ends that.", flush=True)
        while True:
            time.sleep(1)


def _shoot(options: ViewOptions, recording: Recording, who: Sequence[MatchPlayer]) -> None:
    """Write a picture: with rerun's panels if there is a graphics driver, otherwise by ray casting alone."""
    from dashboards import viewer
    from dashboards.film.film import Film, save_picture
    from dashboards.viewer.headless import NO_DRIVER

    path, at = options.shot, float(recording.time[-1]) * 2 / 3 if options.at is None else options.at
    assert path is not None
    try:
        viewer.screenshot(recording, path, at, players=who)
    except ViewerError as error:
        if str(error) != NO_DRIVER:
            raise
        film = Film(recording, PICTURE, who)
        print(f"league: {NO_DRIVER}; without one it is drawn without curves and panels", file=sys.stderr)
        save_picture(film, path, at)
    print(f"Wrote {path}.")


def _film(options: ViewOptions, recording: Recording, who: Sequence[MatchPlayer]) -> None:
    from dashboards.film.film import Film, require_encoder, save_film

    path, begin = options.video, recording.time[0] if options.at is None else options.at
    assert path is not None
    require_encoder(path)
    end = recording.time[-1] if options.seconds is None else begin + options.seconds
    with Progress("league watch") as progress:
        tell = partial(progress.tell, "pictures")
        save_film(Film(recording, FILM, who), path, options.rate, (float(begin), float(end)), tell)
    print(f"Wrote {path}, {path.stat().st_size / 1e6:.1f} MB.")
