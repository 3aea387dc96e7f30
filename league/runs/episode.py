"""A recorded episode as arrays: positions, actions, rewards, events; and as a film."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dashboards.errors import ViewerError
from dashboards.identity import MatchPlayer
from storage.errors import StorageError
from storage.recordings.recording import Recording, RecordingHeader

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class Episode:
    """One recorded episode of T control steps. `match` is its number in the league.

    A notebook shows it as a film, which is drawn when it is shown first.
    """

    match: int
    recording: Recording
    players: tuple[MatchPlayer, ...] | None = None  # names, colours and ratings for the film

    def __repr__(self) -> str:
        sides = " against ".join(self.header.sides)
        return f"<episode of match {self.match}: {sides}, {self.recording.steps} steps, {self.header.outcome}>"

    def film(self) -> Path:
        """Return a film of the episode, or of its last 10 s, as a WebM file of at most 300 kB in the cache folder.

        It is drawn once, in about 8 s of one core. Raises ViewerError without ffmpeg or Pillow, StorageError where the
        folder cannot be written.
        """
        from league.matches.match_clips import kept_clips

        return kept_clips().make(self.recording, self.players).path

    def _repr_html_(self) -> str:
        """Return the film as a notebook shows it; where none can be made, the reason."""
        from dashboards.web.document import FilmBlock, film_markup

        text = repr(self).strip("<>")
        try:
            shown = FilmBlock.embedded(self.film(), text)
        except (ViewerError, StorageError) as error:
            shown = FilmBlock(f"{text}. No film: {error}.")
        return film_markup(f"match-{self.match}", shown)

    @property
    def header(self) -> RecordingHeader:
        """The players, the seed, the arena, the outcome."""
        return self.recording.header

    @property
    def time(self) -> np.ndarray:
        """(T,) Times in s."""
        return self.recording.time

    @property
    def qpos(self) -> np.ndarray:
        """(T, nq) MuJoCo's joint positions, of the model in `recording.xml`."""
        return self.recording.qpos

    @cached_property
    def positions(self) -> dict[str, np.ndarray]:
        """(T, 3) Positions in m of each robot's base, by agent, and of each loose body, such as a ball.

        Empty in a game without bodies. The poses of all bodies are `dashboards.replay.replay(episode.recording)`.
        """
        if not self.qpos.shape[1]:
            return {}
        from dashboards.replay import loose_bodies, replay

        scene = replay(self.recording)
        bodies = {robot.agent: robot.body for robot in scene.robots} | loose_bodies(scene)
        return {name: scene.xpos[:, body] for name, body in bodies.items()}

    @property
    def actions(self) -> Mapping[str, np.ndarray]:
        """(T, act) Actions of each agent."""
        return self.recording.actions

    @property
    def rewards(self) -> np.ndarray:
        """(T, teams) Rewards of each step, in the order of `header.teams`."""
        return self.recording.reward

    @property
    def terms(self) -> Mapping[str, np.ndarray]:
        """(T, teams) Terms of the reward, by name."""
        return self.recording.terms

    @property
    def events(self) -> "pd.DataFrame":
        """A row for each event: step, time in s, text."""
        import pandas as pd

        rows = [(step, float(self.time[step]), text) for step, text in self.recording.events]
        return pd.DataFrame(rows, columns=pd.Index(["step", "time", "text"]))
