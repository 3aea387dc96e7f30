"""The clip at the top of README: a match between policies that come with the league.

    python -m scripts.readme_clip --look                 # list what happens in each match, to choose one
    python -m scripts.readme_clip                        # draw docs/pictures/sumo.webp

It needs neither a GPU nor a graphics driver.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import arenas
from dashboards.film.film import Film, save_film
from dashboards.identity import COLOURS, MatchPlayer
from league.config.experiment import Config
from league.matches.adhoc_matches import exhibition, pairing
from league.queries.query import Open
from league.runtime.preflight import create
from storage.recordings.recording import Recording, from_bytes
from storage.store import Store

ARENA, SIDES = "sumo-by-team", ("anymals-sumo", "leatherbacks-sumo")
EPISODES, CHOSEN = 10, 5
FILE = Path(__file__).parents[1] / "docs" / "pictures" / "sumo.webp"
SIZE, RATE = (800, 450), 20  # pixels, pictures per second


def matches() -> list[Recording]:
    """Play matches of the two policies; always the same ones, because their seed follows from the names."""
    config = Config(arena=arenas.settings(ARENA), league="clip")
    config = replace(config, rating=replace(config.rating, record=True))
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, config.arena.build(engine="c", worlds=1))
        opened = Open(store, "clip")
        played = exhibition(pairing(opened, *SIDES), EPISODES, EPISODES).matches
        return [from_bytes(store.blobs.get(str(match.recording))) for match in played]


def main() -> None:
    """Draw one of the matches, or list what happens in each."""
    asked = argparse.ArgumentParser(description="A clip of a match between policies that come with the league.")
    asked.add_argument("file", nargs="?", type=Path, default=FILE)
    asked.add_argument("--episode", type=int, default=CHOSEN)
    asked.add_argument("--look", action="store_true", help="draw nothing; list what happens in each match")
    options = asked.parse_args()
    played = matches()
    if options.look:
        for number, recording in enumerate(played):
            events = "; ".join(f"{recording.time[step]:.1f} s {text}" for step, text in recording.events)
            print(f"{number}: {events}")
        return
    players = [MatchPlayer(name, colour) for name, colour in zip(SIDES, COLOURS, strict=False)]
    recording = played[options.episode]
    film = Film(recording, SIZE, players, close=True, labels=False)
    save_film(film, options.file, RATE, (0.0, float(recording.time[-1])), lambda *_: None)
    print(f"Wrote {options.file}, {options.file.stat().st_size / 1e6:.1f} MB.")


if __name__ == "__main__":
    main()
