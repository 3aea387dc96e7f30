"""Files of matches on a disk without room: an error, and nothing is left of the file."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

from dashboards import viewer
from dashboards.errors import ViewerError
from dashboards.export.foxglove import write_foxglove
from dashboards.film import film
from storage.errors import StorageError
from tests.dashboards.cars import cars

ROOM = 2048  # bytes


@contextmanager
def little_room() -> Iterator[None]:
    """Files of this process cannot grow beyond ROOM, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (ROOM, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def _film(path: Path) -> None:
    film.save_film(film.Film(cars(), (160, 100)), path, 2, (0.0, 1.0), lambda *_: None)


WRITERS = {
    "match.rrd": partial(viewer.write_rrd, cars()),
    "match.mcap": partial(write_foxglove, cars()),
    "match.png": lambda path: film.save_picture(film.Film(cars(), (400, 250)), path, 1.0),
    "match.gif": _film, "match.webp": _film, "match.mp4": _film,
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_nobody_is_told_of_a_file_that_the_disk_has_not_taken(name: str, tmp_path: Path):
    if name.endswith(".mp4"):
        film.ffmpeg()
    told = r"[Nn]o space left|[Ff]ile too large|ffmpeg made no film"
    with pytest.raises((StorageError, ViewerError), match=told), little_room():
        WRITERS[name](tmp_path / name)
    assert list(tmp_path.iterdir()) == []
    WRITERS[name](tmp_path / name)
    assert (tmp_path / name).stat().st_size > ROOM  # so it was for want of room
