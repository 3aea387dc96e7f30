"""Population based training: decide from the store which player copies which, and keep hyperparameters in checkpoints.

A copy is part of a turn, which names the checkpoint that is copied: the player continues from that state with
hyperparameters of its own, learns, and is snapshotted when the turn ends, with the other player's newest snapshot as
parent. The turn's one transaction writes all of this. The snapshot is the only record of a copy.
"""

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from league.state.league_state import LeagueState
from matchmaking.pbt import draw_partner, present_name
from matchmaking.ratings.scores import Score, quantile
from matchmaking.schedule import phase_score
from storage.records import Player, Snapshot

if TYPE_CHECKING:  # a query reads no configuration
    from agents.settings import HappoConfig
    from league.config.experiment import Config

PREFIX = "hyperparameter."  # in a player's checkpoint
Copy = tuple[str, str, str]  # player, digest of its checkpoint, its newest snapshot


def copy_now(config: "Config", state: LeagueState, player: Player) -> Copy | None:
    """Return the copy that a player makes in the turn that begins now; None without a copy.

    A ready player is compared with one other ready player of its team and role. The seed, its name and its iteration
    determine which one.
    """
    rivals = [p for p in state.players if _are_rivals(config, p, player) and _is_ready(config, state, p)]
    if not _is_ready(config, state, player):
        return None
    name = draw_partner([p.name for p in rivals], _partner_rng(config.seed, state, player))
    if name is None or surely_scores(config, state, player.name, name)[1] >= config.training.pbt.score:
        return None
    return name, state.checkpoints[name].digest, state.history(name)[-1].name


def surely_scores(config: "Config", state: LeagueState, player: str, other: str) -> tuple[float, float]:
    """Return the 95 % interval of a player's score against another of its team; (0, 1) if either has no data."""
    by_rating = config.training.pbt.by == "rating"
    return _by_rating(state, player, other) if by_rating else _by_win_rate(state, player, other)


def since(state: LeagueState, player: str) -> Snapshot:
    """Return the snapshot of a player's last copy: the last with another player's snapshot as parent, or the first."""
    frozen, history = state.by_name, state.history(player)
    copied = [s for s in history if (parent := frozen.get(s.parent or "")) is not None and parent.player != player]
    return copied[-1] if copied else history[0]


def _are_rivals(config: "Config", one: Player, other: Player) -> bool:
    return (one.team, one.role) == (other.team, other.role) and one.name != other.name and one.paused is None


def _is_ready(config: "Config", state: LeagueState, player: Player) -> bool:
    ready, at = config.training.pbt.ready, state.checkpoints.get(player.name)
    if ready is None or at is None or not state.history(player.name) or config.role(player.role).can_reset:
        return False
    return at.step - since(state, player.name).step >= ready


def _partner_rng(seed: int, state: LeagueState, player: Player) -> np.random.Generator:
    at = state.checkpoints.get(player.name)
    return decision_rng(seed, player.name, at.iteration if at else 0, "partner")


def decision_rng(seed: int, player: str, iteration: int, purpose: str) -> np.random.Generator:
    """Return the random generator of a decision about a player at an iteration; it is the same at each call."""
    return np.random.default_rng([seed, iteration, crc32(f"{player}/pbt/{purpose}".encode())])


def _by_rating(state: LeagueState, player: str, other: str) -> tuple[float, float]:
    """Return the interval computed from the ratings of each player's newest rated snapshot."""
    ladder = state.ladder
    rated = [[s.name for s in state.history(name) if ladder.known(s.name)][-1:] for name in (player, other)]
    if not all(rated):
        return 0.0, 1.0
    i, j = (ladder.ratings.index(name) for (name,) in rated)
    gap = float(ladder.ratings.strength[i] - ladder.ratings.strength[j])
    reach = quantile(0.95) * math.sqrt(ladder.ratings.variance_of_gap(i, j))
    low, high = (1 / (1 + 10 ** (-elo / 400)) for elo in (gap - reach, gap + reach))
    return low, high


def _by_win_rate(state: LeagueState, player: str, other: str) -> tuple[float, float]:
    """Return the interval of ½ plus the difference of the two recent win rates in training.

    The interval is Newcombe's (1998), method 10, of the difference of two proportions.
    """
    a, b = _of_late(state, player), _of_late(state, other)
    if not a.games or not b.games:
        return 0.0, 1.0
    low = a.score - b.score - math.hypot(a.score - a.low, b.high - b.score)
    high = a.score - b.score + math.hypot(a.high - a.score, b.score - b.low)
    return max(0.0, 0.5 + low), min(1.0, 0.5 + high)


def _of_late(state: LeagueState, player: str) -> Score:
    """Compute a player's score in its newest training games since its last copy.

    Turns are added, newest first, until there are 500 games or more, as far as they exist.
    """
    games = state.training_games.of_player(player)
    games = games[games["iteration"] > since(state, player).iteration]
    turns, at = np.unique(games["iteration"], return_inverse=True)
    wins, draws, losses = (np.bincount(at, games[name], len(turns)) for name in ("wins", "draws", "losses"))
    played = wins + draws + losses
    return phase_score([(n, w / n) for n, w in zip(played.tolist(), (wins + draws / 2).tolist(), strict=True) if n])


# In a checkpoint -----------------------------------------------------------------------------------------------------


def hyperparameters(settings: "HappoConfig", names: Sequence[str]) -> dict[str, float]:
    """Return the values of a learner's movable hyperparameters."""
    return {name: float(getattr(settings, name)) for name in names}


def written(own: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Return the checkpoint entries of movable hyperparameters."""
    return {f"{PREFIX}{name}": np.array(value) for name, value in own.items()}


def read(state: Mapping[str, np.ndarray], names: Sequence[str]) -> dict[str, float]:
    """Read the movable hyperparameters of a checkpoint; one written before they were declared has none.

    `names` and those in the checkpoint may be former names; the result has the present ones.
    """
    own = {key.removeprefix(PREFIX): value for key, value in state.items() if key.startswith(PREFIX)}
    known = {present_name(name): float(value) for name, value in own.items()}
    return {name: known[name] for name in map(present_name, names) if name in known}
