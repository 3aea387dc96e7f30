"""Clips of the clearest games of each kind of end, as recordings and films."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from dashboards.film.film import Film, save_film
from dashboards.identity import COLOURS, MatchPlayer
from experiments.policy_files import INITIAL
from experiments.role_metrics import End, Game, ended_by
from storage.recordings.recording import Recording, to_bytes

WANTED = (("anymal", "leatherback"), ("leatherback", "anymal"))  # who lost, ended by whom
FILM_SECONDS, FILM_SIZE, FILM_RATE = 8.0, (800, 450), 20


class Example(NamedTuple):
    """A game that one robot lost."""

    end: End
    recording: Recording
    pair: tuple[str, str]

    @property
    def clarity(self) -> tuple[bool, float, float]:
        """Return what makes it clear, the more the better: the one who ended it came from inside, long contact in the
        last second, and a length near that of a film.
        """
        return self.end.inside, self.end.contact, -abs(self.recording.time[-1] - FILM_SECONDS)


@dataclass
class Examples:
    """The clearest game of each kind of end, and how many there were."""

    best: dict[tuple[str, str], Example] = field(default_factory=dict)  # (kind that lost, ended by)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)

    def add(self, game: Game, recording: Recording, pair: tuple[str, str]) -> None:
        """Count a game that one robot lost to a newest policy, and keep it if it is the clearest."""
        if len(game.ends) != 1:
            return
        (end,) = game.ends
        won = int(1 - game.team[end.loser])
        if recording.header.sides[won].endswith(INITIAL):
            return
        what = game.kind[end.loser], ended_by(game, end)
        self.counts[what] += 1
        example, known = Example(end, recording, pair), self.best.get(what)
        if known is None or example.clarity > known.clarity:
            self.best[what] = example

    def chosen(self) -> list[tuple[str, str]]:
        """Return the ends to show: those wanted that there are, and the commonest of the others."""
        others = [what for what, _ in self.counts.most_common() if what not in WANTED]
        return [*(what for what in WANTED if what in self.best), *others[:1]]


def write_clips(examples: Examples, folder: Path) -> Iterator[dict[str, Any]]:
    """Write the chosen games as a recording and a film of their last seconds; yield what JSON has of each."""
    folder.mkdir(parents=True, exist_ok=True)
    for lost, by in examples.chosen():
        last, recording, pair = examples.best[lost, by]
        name, header = f"{lost}-ended-by-{by}", recording.header
        (folder / f"{name}.mcap").write_bytes(to_bytes(recording))
        players = [MatchPlayer(side, colour) for side, colour in zip(header.sides, COLOURS, strict=False)]
        end = float(recording.time[-1])
        film = Film(recording, FILM_SIZE, players, close=True)
        save_film(film, folder / f"{name}.webp", FILM_RATE, (max(0.0, end - FILM_SECONDS), end), lambda *_: None)
        yield {
            "lost": lost, "by": by, "games": examples.counts[lost, by], "file": name, "how": last.how,
            "inside": last.inside, "contact": round(last.contact, 2), "seconds": round(end, 2),
            "pair": list(pair), "sides": list(header.sides), "seed": header.seed, "world": header.world,
        }  # fmt: skip
