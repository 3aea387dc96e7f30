"""A league's players in one process: their learners, how far each has come, and how they are saved and brought back."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

from agents.parallel import ALONE, Together
from arenas.arena import Arena
from league import fading, lives, population
from league.config.experiment import Config
from league.jobs import TrainingTurn
from league.learners import begin_anew, new_learner, settings_of
from league.policies import freeze
from league.studies import Studies
from matchmaking.pbt import explored
from matchmaking.roles import Role
from storage import arrays
from storage.records import ArenaKey, Checkpoint, Meeting, Player, Snapshot
from storage.store import Store


@dataclass(frozen=True)
class Counters:
    """How far a player has come, as its newest checkpoint's row says it."""

    iteration: int = 0
    steps: int = 0  # decisions × worlds that it learnt from
    seconds: float = 0.0  # of training


class Squad:
    """All players of a league. The store's checkpoints are the truth about their learners."""

    def __init__(self, config: Config, arena: Arena, players: Sequence[Player], together: Together = ALONE):
        self.config, self.arena, self.together = config, arena, together
        self.league = players[0].league
        self.players = {player.name: player for player in players}
        self.learners = {player.name: new_learner(config, arena, player, together) for player in players}
        self.counters = {player.name: Counters() for player in players}
        self.histories: Mapping[str, list[Snapshot]] = {}  # of the players of the turn, oldest first
        self.studies = Studies(list(self.learners.values()))
        self._fading = {name: self._unfaded() for name in self.players}
        self._at = dict.fromkeys(self.players, "")  # digests of the checkpoints that the learners stand at
        self._log: list[Meeting] = []  # of the store's, as far as it was read

    def role(self, name: str) -> Role:
        """A player's role, with nothing left open."""
        return self.config.role(self.players[name].role)

    def resting(self, turn: TrainingTurn) -> list[str]:
        """Players that sit in the turn and rest; critics of those that are paused or never learn stand still too."""
        rest = [name for name in turn.present if name and name not in turn.learners and self.role(name).learns]
        return [name for name in rest if self.players[name].paused is None]

    def spent(self, turn: TrainingTurn) -> bool:
        """Whether the group has had its budget; `plan.spent` says the same of what the store holds."""
        total = sum if self.config.training.schedule.adds_up else max
        at = [self.counters[name] for name in turn.present if name]
        seconds = 0.0 if self.config.deterministic else total([c.seconds for c in at])
        return self.config.budget.spent(seconds, total([c.steps for c in at]))

    def meetings(self, store: Store) -> list[Meeting]:
        """What came of all training games that the store knows of."""
        self._log += store.meetings(self.league, self._log[-1].id if self._log else 0)
        return self._log

    # The weight of the dense reward ----------------------------------------------------------------------------------

    def shaping(self, name: str) -> float:
        """Weight of a player's dense reward as it stands."""
        fades = self._fading[name]
        begun = lives.fresh_since(self.role(name), self.config.seed, name, self.histories[name])
        return fades.weight if fades else fading.by_steps(self.config.training, self.counters[name].steps - begun)

    def note(self, name: str, figures: Mapping[str, float]) -> None:
        """Have it follow what an iteration of a player was like, where it follows success."""
        if fades := self._fading[name]:
            fades.note(figures)

    def _unfaded(self) -> fading.BySuccess | None:
        return fading.begun(self.config.training, len(self.arena.teams))

    # Saved and brought back ------------------------------------------------------------------------------------------

    def restore(self, store: Store, turn: TrainingTurn) -> bool:
        """Bring every player of the turn to the checkpoint that the turn starts from; whether any stood elsewhere."""
        self._at = self.together.first(self._at)
        self.players = {player.name: player for player in store.players(self.league)}  # one may have been paused
        self.histories = {name: store.snapshots(self.league, name) for name in turn.present if name}
        moved = False
        for name, digest in turn.bases.items():
            if digest and (digest != self._at[name] or turn.dice):
                self._load(store, name, digest, turn.dice)
                moved = True
            self._at[name] = digest
            kept = store.checkpoint(self.league, name)
            self.counters[name] = Counters(kept.iteration, kept.step, kept.seconds) if kept else Counters()
        return moved

    def _load(self, store: Store, name: str, digest: str, dice: int) -> None:
        state = arrays.from_bytes(store.blobs.get(digest))
        self._move(name, self._begun_with(name) | population.read(state, self._movable))
        self.learners[name].load(state)
        if fades := self._fading[name]:
            fades.load(state)
        if dice:
            self.learners[name].rng.manual_seed(crc32(f"{self.config.seed}/{name}/{dice}".encode()))

    def checkpoint(self, store: Store, name: str, key: ArenaKey) -> Checkpoint:
        """A player as it is now; its bytes are in the store, the row is to be written."""
        at, fades = self.counters[name], self._fading[name]
        moved = population.written(self.moved(name))
        state = self.learners[name].state() | moved | (fades.state() if fades else {})
        digest = store.blobs.put(arrays.to_bytes(state))
        return Checkpoint(self.league, name, digest, at.steps, at.iteration, at.seconds, key)

    def written(self, checkpoints: Sequence[Checkpoint]) -> None:
        """These are in the store now, and the learners stand at them."""
        self._at |= {checkpoint.player: checkpoint.digest for checkpoint in checkpoints}

    def freeze(self, name: str) -> bytes:
        """A player's actors as they are now: bytes, which nothing that is learnt later can change."""
        policies = self.learners[name].policies()
        return freeze([{key: tensor.cpu().numpy() for key, tensor in policy.items()} for policy in policies])

    # Going on from others --------------------------------------------------------------------------------------------

    def take_over(self, name: str, source: str) -> None:
        """Give a player another's actors, and where its dense reward fades by success, the other's weight if less.

        Critic, optimisers and random numbers stay its own.
        """
        state, agents = self.learners[source].state(), len(self.learners[name].actors)
        self.learners[name].inherit([(state, i) for i in range(agents)], None)
        mine, theirs = self._fading[name], self._fading[source]
        if mine and theirs:
            mine.follow(theirs)

    def copy(self, store: Store, turn: TrainingTurn) -> bool:
        """Population based training: who copies in the turn goes on from the other's whole state; whether anybody does.

        With hyperparameters and random numbers of its own: those follow from the seed, its name and where it stands.
        """
        for name, (source, digest, _) in turn.copies.items():
            state, at = arrays.from_bytes(store.blobs.get(digest)), self.counters[name].iteration
            theirs = self._begun_with(source) | population.read(state, self._movable)
            dice = population.dice(self.config.seed, name, at, "explore")
            pbt = self.config.training.pbt
            self._move(name, explored(self.moved(name), theirs, self._begun_with(name), pbt, dice))
            self.learners[name].load(state)
            self.learners[name].rng.manual_seed(crc32(f"{self.config.seed}/{name}/{at}/copy".encode()))
            other = self._unfaded()
            if (mine := self._fading[name]) and other:
                other.load(state)
                mine.follow(other)
        return bool(turn.copies)

    def moved(self, name: str) -> dict[str, float]:
        """A player's hyperparameters that may move, as it has them now."""
        return population.hyperparameters(self.learners[name].config, self._movable)

    def _begun_with(self, name: str) -> dict[str, float]:
        """The same as its settings have them."""
        return population.hyperparameters(settings_of(self.config, self.players[name]), self._movable)

    @property
    def _movable(self) -> tuple[str, ...]:
        pbt = self.config.training.pbt
        return () if pbt.ready is None else pbt.hyperparameters

    def _move(self, name: str, moved: Mapping[str, float]) -> None:
        """Have a player learn with these; its learner is made anew, for they are part of what is compiled."""
        if moved.items() - self.moved(name).items():
            self.learners[name] = new_learner(self.config, self.arena, self.players[name], self.together, moved)

    def begin_anew(self, store: Store, name: str, source: Snapshot) -> None:
        """Have a player whose life is over go on from a snapshot's actors, with all else as at its beginning."""
        learner, player, at = self.learners[name], self.players[name], self.counters[name].iteration
        begin_anew(learner, self.config, self.arena, player, store, source, at, self.together)
        if self.role(name).reset == "initial":
            self._fading[name] = self._unfaded()
