"""What `league run` prints: a line while it runs; at its end who is better, how sure that is, what to type next."""

import shutil
import sys
import time
from dataclasses import dataclass, field

from league import plan
from league.config import Config
from league.plan import Standing
from league.query import rated, rating_rows, score_text
from league.tables import ratings_table
from storage.records import Snapshot, Worker

NEXT = """Next:
  league ratings     who is better, and how sure that is
  league watch       a recorded match in 3D (league watch --shot match.png where there is no display)
  league run         go on training from where it stopped"""


@dataclass
class Ticker:
    """Prints a status line every few seconds; on a terminal it rewrites one line, elsewhere it adds lines."""

    config: Config
    every: float = 5.0
    began: float = field(default_factory=time.monotonic)
    _told: float = 0.0
    _matches: int = -1
    _ratings: str = ""

    def __call__(self, standing: Standing, phase: str, workers: list[Worker]) -> None:
        """Tell how the league stands, if it is time."""
        live = sys.stdout.isatty()
        now = time.monotonic()
        if now - self._told < (1.0 if live else self.every) and phase in ("training", "rating"):
            return
        self._told = now
        line = " · ".join(filter(None, (_clock(now - self.began), *self._doing(standing, phase, workers))))
        if live:
            print(f"\r\033[K{line[: _width()]}", end="" if phase in ("training", "rating") else "\n", flush=True)
        else:
            print(line, flush=True)

    def _doing(self, standing: Standing, phase: str, workers: list[Worker]) -> list[str]:
        said = {w.kinds: w.status for w in workers}
        episodes = sum(m.wins + m.draws + m.losses for m in standing.matches)
        tail = [f"{episodes:,} rated episodes", self._rated(standing)]
        if phase != "training":
            return [phase, *tail]
        learner = said.get(plan.TRAIN, {})
        if "steps" not in learner:
            return [learner.get("doing", "starting workers")]
        left = self.config.budget.train_seconds - learner["seconds"]
        return [
            f"{'+'.join(learner['learners'])} learn", f"iteration {learner['iteration']}",
            f"{learner['steps']:,} steps", f"{learner['steps_per_second']:,.0f} steps/s",
            *(tail if standing.matches else tail[:1]),
            f"{_clock(max(0.0, left))} left" if left < float("inf") else "",
        ]  # fmt: skip

    def _rated(self, standing: Standing) -> str:
        """Elo and score against initial of each player's newest rated snapshot; fitted again only after new matches."""
        if len(standing.matches) != self._matches:
            self._matches = len(standing.matches)
            rows = {row["name"]: row for row in rating_rows(standing.snapshots, standing.matches)}
            parts = []
            for player in standing.players:
                known = [s for s in standing.history(player.name) if rows[s.name]["elo"] is not None and s.iteration]
                if known:
                    row = rows[known[-1].name]
                    against = row["vs_initial"]
                    score = f" ({100 * against:.0f} % vs initial)" if against is not None else ""
                    parts.append(f"{row['name']} Elo {row['elo']:.0f}±{(row['high'] - row['low']) / 2:.0f}{score}")
            self._ratings = ", ".join(parts)
        return self._ratings


def summary(config: Config, standing: Standing) -> str:
    """The ratings table, each newest snapshot against its yardsticks, and the next things to type."""
    parts = [ratings_table(standing.snapshots, standing.matches), *_yardsticks(config, standing)]
    return "\n\n".join([*parts, *_who_is_better(standing), NEXT])


def _who_is_better(standing: Standing) -> list[str]:
    """How sure it is that one player's newest snapshot is stronger than another's."""
    newest = plan.newest_snapshots(standing)
    if len(newest) < 2 or not standing.matches:
        return []
    ratings = rated(standing.snapshots, standing.matches)
    first, second, *_ = sorted(newest, key=lambda s: -ratings.elo[ratings.index(s.digest)])
    sure = ratings.likelihood_of_superiority(first.digest, second.digest)
    return [f"{first.name} is stronger than {second.name} with probability {100 * sure:.0f} %."]


def _yardsticks(config: Config, standing: Standing) -> list[str]:
    payoff = standing.payoff()
    blocks = []
    for snapshot in plan.newest_snapshots(standing):
        lines = [f"{snapshot.name} against"]
        for other in plan.yardsticks(config, standing, snapshot):
            score = payoff.score(snapshot.digest, other.digest)
            if score.games:
                lines.append(f"  {_title(snapshot.player, other):<32} {score_text(score)}")
        if len(lines) > 1:
            blocks.append("\n".join(lines))
    return blocks


def _title(player: str | None, other: Snapshot) -> str:
    if other.script:
        return other.name
    own = "its own " if other.player == player else ""
    return f"{own}{other.name} ({other.seconds:.0f} s)"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes}:{rest:02d}"


def _width() -> int:
    return shutil.get_terminal_size().columns - 1
