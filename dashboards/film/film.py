"""Pictures and films of a match, drawn with `dashboards.film.raycaster`: without a graphics driver, and for clips."""

import functools
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from dashboards.errors import ViewerError
from dashboards.film.raycaster import Raycaster
from dashboards.identity import MatchPlayer, named_events, shape
from dashboards.replay import Replay, drawn_markers, replay
from dashboards.system.outputs import FILMS, PICTURES, new_output, require_kind
from dashboards.viewer.camera import Camera, framed_radius
from dashboards.viewer.panels import TRAIL, grid_spacing
from dashboards.viewer.scene import MARKER_COLOURS, WHITE, circles
from storage.recordings.recording import Recording

LAST_PICTURE_SECONDS = 1.0  # a film's last picture stays so long
SUPERSAMPLING = 2  # factor of resolution each way before pixels are averaged, which smooths edges
NO_FFMPEG = (
    "an .mp4 or .webm needs ffmpeg: pip install 'robot-league[video]' brings it; .gif and .webp need nothing more"
)
ENCODERS = {
    ".mp4": ("-c:v", "libx264", "-crf", "23", "-movflags", "+faststart"),
    ".webm": ("-c:v", "libvpx-vp9", "-crf", "32", "-deadline", "good", "-cpu-used", "4", "-row-mt", "1"),
}
"""ffmpeg's options by suffix. Browsers play VP9 in WebM without a licensed decoder, which H.264 needs."""
INK, FAINT, BAND = (235, 238, 245), (165, 172, 184), (17, 21, 30)


class Film:
    """Pictures of the moments of one match."""

    def __init__(
        self,
        recording: Recording,
        size: tuple[int, int],
        players: Sequence[MatchPlayer] | None = None,
        close: bool = False,
        labels: bool = True,
        stage: tuple[np.ndarray, float] | None = None,
    ):
        """Prepare pictures of `size` pixels, of the whole scene, or with `close` only of the region that robots reach.

        A `stage`, centre (3,) and radius in m, is framed in its place.

        `labels` above the robots hide part of the background. The caption at the top shows each player in its colour.
        """
        self.recording, self.size, self.labels = recording, size, labels
        self.scene: Replay = replay(recording, players)
        self._markers = drawn_markers(recording, self.scene)
        centre, radius = stage or (_stage(self.scene) if close else (np.zeros(3), self.scene.radius))
        radius = framed_radius(self.scene, centre, radius)
        self.camera = Camera.framing(centre, radius, (SUPERSAMPLING * size[0], SUPERSAMPLING * size[1]))
        self._raycaster = Raycaster(self.scene, self.camera, grid_spacing(self.scene.radius))

    def picture(self, step: int) -> Any:
        """Return a PIL image of a step: the world, the players, and below it time, score and recent events."""
        image, pens = _pillow().Image, _pillow().ImageDraw
        self._raycaster.pose(self.recording.qpos[step])
        world = image.fromarray(self._raycaster.ground().astype(np.uint8))
        self._lines(pens.Draw(world), step)
        bodies, there = self._raycaster.bodies()
        world.paste(image.fromarray(bodies.astype(np.uint8)), (0, 0), image.fromarray(there))
        world = world.resize(self.size, image.Resampling.BOX)
        pen = pens.Draw(world)
        if self.labels:
            self._labels(pen, step)
        self._caption(pen, step)
        return world

    def _lines(self, pen: Any, step: int) -> None:
        """Draw markers, the shapes of the sides and the recent paths of robots as lines on the ground."""
        recording, scene, thin = self.recording, self.scene, 0.004 * self.scene.radius
        for kind, every in self._markers.values():
            values = every[step : step + 1]
            if kind == "circle":
                self._line(pen, circles(values, thin)[0], MARKER_COLOURS[kind], 3)
            elif kind == "segment":
                self._line(pen, values.reshape(2, 3), MARKER_COLOURS[kind], 2)
            else:
                self._ball(pen, values[0], MARKER_COLOURS[kind], filled=kind == "ball")
        first = int(np.searchsorted(recording.time, recording.time[step] - TRAIL))
        for robot in scene.robots:
            at = scene.xpos[: step + 1, robot.body] * np.array([1, 1, 0])
            self._line(pen, at[first:], scene.players[robot.side].colour, 2)
            ring = circles(np.array([[0, 0, robot.size]]), thin, shape(robot.side)[1])[0]
            self._line(pen, ring + at[-1], WHITE, 2)

    def _line(self, pen: Any, points: np.ndarray, colour: tuple[int, ...], width: int) -> None:
        seen = self.camera.project(points)
        if len(seen) > 1 and (seen[:, 2] > 0).all() and np.isfinite(seen).all():
            pen.line(
                [tuple(point) for point in seen[:, :2].tolist()],
                fill=colour,
                width=SUPERSAMPLING * width,
                joint="curve",
            )

    def _ball(self, pen: Any, values: np.ndarray, colour: tuple[int, ...], filled: bool) -> None:
        x, y, ahead = self.camera.project(values[None, :3])[0]
        if ahead > 0 and np.isfinite(x + y):
            r = values[3] * self.camera.focus / ahead
            pen.ellipse(
                (x - r, y - r, x + r, y + r), outline=colour, width=SUPERSAMPLING, fill=colour if filled else None
            )

    def _labels(self, pen: Any, step: int) -> None:
        font = _font(self.size[1] / 40)
        for robot in self.scene.labelled:
            player = self.scene.players[robot.side]
            over = self.scene.label(robot)[step]
            x, y, ahead = self.camera.project(over[None])[0] / [SUPERSAMPLING, SUPERSAMPLING, 1]
            if ahead > 0 and np.isfinite(x + y):
                box = pen.textbbox((x, y), player.label, font=font, anchor="mb")
                pen.rounded_rectangle((box[0] - 4, box[1] - 2, box[2] + 4, box[3] + 3), 3, fill=BAND)
                pen.text((x, y), player.label, font=font, anchor="mb", fill=player.colour)

    def _caption(self, pen: Any, step: int) -> None:
        """Draw the players at the top, and the time and recent events at the bottom."""
        recording, players, h = self.recording, self.scene.players, self.size[1]
        small, x, gap = _font(h / 28), h / 40, h / 40
        named, font = self._title(pen, self.size[0] - 2 * gap)
        for number, (player, text) in enumerate(zip(players, named, strict=True)):
            if number:
                pen.text((x, gap), "against", font=font, fill=FAINT)
                x += pen.textlength("against ", font=font)
            pen.text((x, gap), text, font=font, fill=player.colour)
            x += pen.textlength(f"{text} ", font=font)
        happened = [text for at, text in named_events(recording, players) if at <= step]
        text = f"{recording.time[step]:5.1f} s   {' · '.join(happened[-3:])}"
        pen.text((h / 40, h - gap), text, font=small, anchor="ls", fill=INK)

    def _title(self, pen: Any, room: float) -> tuple[list[str], Any]:
        """Return what is said of each player at the top, and its font: as much as `room` pixels hold.

        Of many players intervals are left out first, then ratings; then letters are smaller.
        """
        players, pixels = self.scene.players, self.size[1] / 22
        ratings = [player.rating for player in players]
        said = [
            [f"{player.name} {rating}".strip() for player, rating in zip(players, some, strict=True)]
            for some in (ratings, [rating.partition(" ±")[0] for rating in ratings], [""] * len(players))
        ]
        font = _font(pixels)
        widths = [pen.textlength(" against ".join(named), font=font) for named in said]
        for named, width in zip(said, widths, strict=True):
            if width <= room:
                return named, font
        return said[-1], _font(pixels * room / widths[-1])


def _pillow() -> Any:
    """Return Pillow's package with the modules used. Raises ViewerError where it is not installed."""
    try:
        import PIL.Image
        import PIL.ImageDraw
        import PIL.ImageFont
    except ImportError as error:
        raise ViewerError("pictures need Pillow; install it with: pip install 'robot-league[video]'") from error
    return PIL


def _font(pixels: float) -> Any:
    return _pillow().ImageFont.load_default(max(10.0, pixels))


def _stage(scene: Replay) -> tuple[np.ndarray, float]:
    """Return the centre of the region that robots reach, and its radius in m, at most the scene's."""
    at = np.concatenate([scene.xpos[:, robot.body, :2] for robot in scene.robots])
    at = at[np.isfinite(at).all(axis=1)]
    centre = (at.min(axis=0) + at.max(axis=0)) / 2
    reach = np.linalg.norm(at - centre, axis=1).max() + max(robot.size for robot in scene.robots)
    return np.append(centre, 0.0), min(scene.radius, float(reach))


def save_picture(film: Film, path: Path, at_seconds: float) -> None:
    """Write a picture of a moment, in the format of the file's suffix.

    Raises ViewerError for another suffix or a moment outside the match, StorageError where the file cannot be written.
    """
    with new_output(path, PICTURES) as partial:
        film.picture(nearest_step(film.recording, at_seconds)).save(partial)


def save_film(
    film: Film, path: Path, rate: int, between: tuple[float, float], progress: Callable[[int, int], None],
    bits: int | None = None,
) -> None:  # fmt: skip
    """Write the seconds `between` of a match as a film of `rate` pictures per second, at real speed.

    An .mp4 or .webm is made by ffmpeg, a .gif or .webp by Pillow. `progress` is called with the pictures done and their
    total. `bits` per second bound a .webm, by and large.
    Raises ViewerError for another suffix, a start outside the match or a missing ffmpeg, StorageError where the file
    cannot be written; nothing is written then.
    """
    require_encoder(path)
    recording = film.recording
    first, last = np.clip(between, recording.time[0], recording.time[-1]).tolist()
    begin = nearest_step(recording, between[0])
    moments = np.arange(first, last, 1 / rate)
    steps = [nearest_step(recording, moment) for moment in moments] or [begin]
    steps += [nearest_step(recording, last)] * round(LAST_PICTURE_SECONDS * rate)
    pictures = _with_progress(film, steps, progress)
    with new_output(path, FILMS) as partial:
        if partial.suffix in ENCODERS:
            _encode(pictures, film.size, rate, partial, [] if bits is None else ["-b:v", str(bits)])
        else:
            _animate(pictures, rate, partial)


def require_encoder(path: Path) -> None:
    """Raise ViewerError if a film of that name cannot be made here."""
    if require_kind(path, FILMS).suffix in ENCODERS:
        ffmpeg()


def nearest_step(recording: Recording, seconds: float) -> int:
    """Return the step nearest to a moment. Raises ViewerError for a moment outside the match."""
    first, last, dt = recording.time[0], recording.time[-1], recording.header.dt
    if not first - dt <= seconds <= last + dt:  # accepts rounded ends: 0, or 2 for 1.9999
        raise ViewerError(f"there is no second {seconds:g} in this match; it has {first:g} to {last:g}")
    return int(np.abs(recording.time - seconds).argmin())


def _with_progress(film: Film, steps: Sequence[int], progress: Callable[[int, int], None]) -> Iterator[Any]:
    drawn = functools.lru_cache(1)(film.picture)
    for number, step in enumerate(steps):
        progress(number, len(steps))
        yield drawn(step)
    progress(len(steps), len(steps))


def _animate(pictures: Iterator[Any], rate: int, path: Path) -> None:
    """Write a film through Pillow. A .gif has the 256 colours of its first picture, to prevent flicker."""
    if path.suffix == ".webp":
        first, *others = pictures
        first.save(path, save_all=True, append_images=others, duration=round(1000 / rate), loop=0, quality=70, method=4)
        return
    first = next(pictures).quantize(256)
    others = [picture.quantize(palette=first, dither=0) for picture in pictures]
    first.save(path, save_all=True, append_images=others, duration=round(1000 / rate), loop=0, optimize=True)


def _encode(pictures: Iterator[Any], size: tuple[int, int], rate: int, path: Path, options: Sequence[str] = ()) -> None:
    """Write a film through ffmpeg, which reads the pictures as they are drawn."""
    command = [
        ffmpeg(), "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}",
        "-r", str(rate), "-i", "-", "-pix_fmt", "yuv420p", *ENCODERS[path.suffix], *options, str(path),
    ]  # fmt: skip
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=said, stderr=said)
        assert process.stdin is not None
        try:
            with suppress(BrokenPipeError), process.stdin:
                for picture in pictures:
                    process.stdin.write(picture.tobytes())
            status = process.wait()
        except BaseException:  # a notebook's stop button reaches this process alone, and would leave a zombie
            process.kill()
            process.wait()
            raise
        said.seek(0)
        if status:
            raise ViewerError(f"ffmpeg made no film: {said.read().decode(errors='replace').strip()[-300:]}")


def ffmpeg() -> str:
    """Return the path of ffmpeg, from this machine or the installed wheel. Raises ViewerError if there is none."""
    if found := shutil.which("ffmpeg"):
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError) as error:
        raise ViewerError(NO_FFMPEG) from error
