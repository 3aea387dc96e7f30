"""Population based training in a league: who copies whom now, read off the store, and what a player's checkpoint says.

A copy is part of a turn, which names whose checkpoint it copies: the player goes on from that state, with
hyperparameters of its own, learns, and is frozen when the turn ends, with the other's newest snapshot as its parent.
All of it is written in the turn's one transaction. That snapshot is all that is remembered of a copy.
"""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from league.standing import Standing
from matchmaking.payoff import Score, quantile
from matchmaking.pbt import partner
from matchmaking.schedule import turn_score
from storage import arrays
from storage.records import Meeting, Player, Snapshot

if TYPE_CHECKING:  # a query reads no configuration
    from agents.settings import HappoConfig
    from league.config.experiment import Config
    from league.query import Open

PREFIX = "hyperparameter."  # in a player's checkpoint
Copy = tuple[str, str, str]  # player, digest of its checkpoint, its newest snapshot


def copy_now(config: "Config", standing: Standing, player: Player) -> Copy | None:
    """Whom a player copies in the turn that begins now; None where nobody, and where there is no such training.

    It compares itself with one of its team and role that is as ready as itself: which of them, follows from the seed,
    its name and where it stands.
    """
    rivals = [p for p in standing.players if _are_rivals(config, p, player) and _is_ready(config, standing, p)]
    if not _is_ready(config, standing, player):
        return None
    name = partner([p.name for p in rivals], _dice(config.seed, standing, player))
    if name is None or surely_scores(config, standing, player.name, name)[1] >= config.training.pbt.score:
        return None
    return name, standing.checkpoints[name].digest, standing.history(name)[-1].name


def surely_scores(config: "Config", standing: Standing, player: str, other: str) -> tuple[float, float]:
    """The 95 % interval of a player's score against another of its team; (0, 1) where nothing is known of either."""
    by_rating = config.training.pbt.by == "rating"
    return _by_rating(standing, player, other) if by_rating else _by_win_rate(standing, player, other)


def since(standing: Standing, player: str) -> Snapshot:
    """The snapshot since which a player has copied nobody: its first, or the last that goes on from another's."""
    owner = {s.name: s.player for s in standing.snapshots}
    history = standing.history(player)
    copied = [s for s in history if owner.get(s.parent or "", player) != player]
    return copied[-1] if copied else history[0]


def _are_rivals(config: "Config", one: Player, other: Player) -> bool:
    return (one.team, one.role) == (other.team, other.role) and one.name != other.name and one.paused is None


def _is_ready(config: "Config", standing: Standing, player: Player) -> bool:
    ready, at = config.training.pbt.ready, standing.checkpoints.get(player.name)
    if ready is None or at is None or not standing.history(player.name) or config.role(player.role).begins_anew:
        return False
    return at.step - since(standing, player.name).step >= ready


def _dice(seed: int, standing: Standing, player: Player) -> np.random.Generator:
    at = standing.checkpoints.get(player.name)
    return dice(seed, player.name, at.iteration if at else 0, "partner")


def dice(seed: int, player: str, iteration: int, purpose: str) -> np.random.Generator:
    """What decides about a player that stands there: the same whenever it is asked."""
    return np.random.default_rng([seed, iteration, crc32(f"{player}/pbt/{purpose}".encode())])


def _by_rating(standing: Standing, player: str, other: str) -> tuple[float, float]:
    """By their newest snapshots whose rating is known."""
    ladder = standing.ladder
    rated = [[s.name for s in standing.history(name) if ladder.known(s.name)][-1:] for name in (player, other)]
    if not all(rated):
        return 0.0, 1.0
    i, j = (ladder.ratings.index(name) for (name,) in rated)
    gap = float(ladder.ratings.strength[i] - ladder.ratings.strength[j])
    reach = quantile(0.95) * math.sqrt(float(ladder.ratings.variances()[i, j]))
    low, high = (1 / (1 + 10 ** (-elo / 400)) for elo in (gap - reach, gap + reach))
    return low, high


def _by_win_rate(standing: Standing, player: str, other: str) -> tuple[float, float]:
    """One half, and by how much one's win rate in training of late lies above the other's.

    The interval is Newcombe's (1998), method 10, of the difference of two shares.
    """
    a, b = _of_late(standing, player), _of_late(standing, other)
    if not a.games or not b.games:
        return 0.0, 1.0
    low = a.score - b.score - math.hypot(a.score - a.low, b.high - b.score)
    high = a.score - b.score + math.hypot(a.high - a.score, b.score - b.low)
    return max(0.0, 0.5 + low), min(1.0, 0.5 + high)


def _of_late(standing: Standing, player: str) -> Score:
    """Its score in its newest training games since its last copy, turn by turn, 500 games or more if there are."""
    begun, turns = since(standing, player).iteration, defaultdict[int, list[Meeting]](list)
    for game in standing.meetings:
        if game.player == player and game.iteration > begun:
            turns[game.iteration].append(game)
    played = {at: sum(m.wins + m.draws + m.losses for m in met) for at, met in turns.items()}
    won = {at: sum(m.wins + m.draws / 2 for m in met) for at, met in turns.items()}
    return turn_score([(played[at], won[at] / played[at]) for at in sorted(turns) if played[at]])


# As it is told -------------------------------------------------------------------------------------------------------


def ready_after(opened: "Open") -> int:
    """Environment steps after which players are compared, and may copy each other; 0 where they never do."""
    return opened.setting("training", "pbt", "ready", otherwise=0)


def words(opened: "Open", standing: Standing) -> dict[str, str]:
    """For each player its hyperparameters, whom it copied last, and when it is compared again; none without any."""
    ready = ready_after(opened)
    names = opened.setting("training", "pbt", "hyperparameters", otherwise=[])
    found = {}
    for player in standing.players if ready else ():
        at = standing.checkpoints.get(player.name)
        if at is None or not standing.history(player.name):
            continue
        own = read(arrays.from_bytes(opened.store.blobs.get(at.digest)), names)
        begun = since(standing, player.name)
        told = [f"{name} {value:.3g}" for name, value in own.items()] or ["no hyperparameter moves"]
        copied = "has copied nobody yet" if begun.initial else f"goes on from {begun.parent} since {begun.name}"
        left = max(0, begun.step + ready - at.step)
        when = f"is compared after {left:,} steps more" if left else "is ready to be compared"
        found[player.name] = f"{', '.join(told)}; {copied}, {when}"
    return found


# In a checkpoint -----------------------------------------------------------------------------------------------------


def hyperparameters(settings: "HappoConfig", names: Sequence[str]) -> dict[str, float]:
    """Those of a learner that may move, as it has them."""
    return {name: float(getattr(settings, name)) for name in names}


def written(own: Mapping[str, float]) -> dict[str, np.ndarray]:
    """What a checkpoint keeps of those that move."""
    return {f"{PREFIX}{name}": np.array(value) for name, value in own.items()}


def read(state: Mapping[str, np.ndarray], names: Sequence[str]) -> dict[str, float]:
    """Those of them that a checkpoint has; one that was written before they were declared has none."""
    return {name: float(state[f"{PREFIX}{name}"]) for name in names if f"{PREFIX}{name}" in state}
