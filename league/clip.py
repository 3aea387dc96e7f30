"""The clip at the top of README: policies that come with the league play each other, and one of their matches is drawn.

    python -m league.clip --look                 # how matches between them go: choose one that tells something
    python -m league.clip                        # docs/pictures/sumo.webp

It needs neither a GPU nor a graphics driver.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import arenas
from dashboards.cast import COLOURS, Performer
from dashboards.film import Film, save_film
from league.bouts import bout, exhibition
from league.config.experiment import Config
from league.prepare import create
from league.query import Open
from storage.recording import Recording, from_bytes
from storage.store import Store

ARENA, SIDES = "sumo-by-team", ("anymals-sumo", "leatherbacks-sumo")
EPISODES, CHOSEN = 10, 5
FILE = Path(__file__).parents[1] / "docs" / "pictures" / "sumo.webp"
SIZE, RATE = (800, 450), 20  # pixels, pictures per second


def matches() -> list[Recording]:
    """Some matches of the two; the same ones each time, for their dice follow from their names."""
    config = Config(arena=arenas.settings(ARENA), league="clip")
    config = replace(config, rating=replace(config.rating, record=True))
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, config.arena.build(engine="c", worlds=1))
        opened = Open(store, "clip")
        played = exhibition(bout(opened, *SIDES), EPISODES, EPISODES)
        return [from_bytes(store.blobs.get(str(match.recording))) for match in played]


def main() -> None:
    """Draw one of the matches, or tell how each goes."""
    asked = argparse.ArgumentParser(description="A clip of a match between policies that come with the league.")
    asked.add_argument("file", nargs="?", type=Path, default=FILE)
    asked.add_argument("--episode", type=int, default=CHOSEN)
    asked.add_argument("--look", action="store_true", help="draw nothing: tell how each match goes")
    options = asked.parse_args()
    played = matches()
    if options.look:
        for number, recording in enumerate(played):
            told = "; ".join(f"{recording.time[step]:.1f} s {text}" for step, text in recording.events)
            print(f"{number}: {told}")
        return
    cast = [Performer(name, colour) for name, colour in zip(SIDES, COLOURS, strict=False)]
    recording = played[options.episode]
    film = Film(recording, SIZE, cast, close=True, labels=False)
    save_film(film, options.file, RATE, (0.0, float(recording.time[-1])), lambda *_: None)
    print(f"Wrote {options.file}, {options.file.stat().st_size / 1e6:.1f} MB.")


if __name__ == "__main__":
    main()
