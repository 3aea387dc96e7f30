"""A training turn: the file to read first.

A *turn* is what one lease covers: some learning iterations of the players whose turn it is, and at its end a checkpoint
of each, and snapshots where they are due, in one transaction. In the words of HARL-A (Peterson et al., 2025): all teams
act in N worlds; then each learning team updates its agents one after the other by HAPPO, from its own rewards, with a
critic and a value normaliser of its own. What is added: in some worlds the other teams may be past snapshots; and a
player whose life ends (`league/lives.py`) is frozen, and then may begin anew.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple
from zlib import crc32

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from agents.batch import Batch
from agents.bridge import Recalled, everywhere, team_batch, to_jax
from agents.errors import Diverged
from agents.happo import compare
from agents.parallel import ALONE, Together
from agents.policy import Crew
from agents.rollout import Trajectory, Worlds, make_reset, make_restart, make_rollout, outcomes, remembering, results
from arenas.arena import Arena
from league import fading, heirs, lives, memory
from league.compiled import Compiled
from league.config import experiment as configuration
from league.config.experiment import Config
from league.jobs import TrainingTurn
from league.learners import begin_anew, beside, new_learner, others
from league.lineup import Lineup
from league.policies import freeze
from league.standing import Standing, episode_scores
from matchmaking.roles import Role
from matchmaking.schedule import Learnt, next_due, remaining, turn_score
from storage import arrays
from storage.records import ArenaKey, Checkpoint, CurvePoint, Lease, Meeting, Phase, Player, Snapshot
from storage.store import Store


@dataclass(frozen=True)
class Counters:
    """How far a player has come, as its newest checkpoint's row says it."""

    iteration: int = 0
    steps: int = 0  # decisions × worlds that it learnt from
    seconds: float = 0.0  # of training


class Progress(NamedTuple):
    """How a turn stands after an iteration."""

    counters: Mapping[str, Counters]  # of the learners
    steps_per_second: float  # in this turn, learning included
    points: tuple[CurvePoint, ...]  # of this iteration


class PlayerDiverged(Exception):  # noqa: N818  (a sentence: "the player diverged")
    """A player's learning went bad; the store still holds its last good checkpoint."""

    def __init__(self, player: str, reason: object):
        super().__init__(f"{player} diverged: {reason}")
        self.player = player


class Trainer:
    """One process's learners, compiled rollout and worlds. The store's checkpoints are the truth about the learners.

    Of several ranks (`league/ranks.py`) each has one, with its part of the `worlds`, and all do the same turns: what
    they decide by is equal everywhere, or what rank 0 says. Rank 0 alone commits.
    """

    def __init__(
        self, config: Config, arena: Arena, players: Sequence[Player], worlds: int, together: Together = ALONE
    ):  # fmt: skip
        self.config, self.arena, self.together = config, arena, together
        self.asked = worlds // together.size
        self.players = {player.name: player for player in players}
        self.learners = {player.name: new_learner(config, arena, player, together) for player in players}
        self.counters = {player.name: Counters() for player in players}
        self._fading = {name: fading.begun(config.training, len(arena.teams)) for name in self.players}
        self._at = dict.fromkeys(self.players, "")  # digests of the checkpoints that the learners stand at
        self._worlds: dict[str, tuple[Worlds, list[tuple[str, ...]]]] = {}  # of each group, and who sat in them
        self._recalled: dict[str, Recalled] = {}  # of players: what their critics remember of the group's worlds
        self._points: list[CurvePoint] = []
        self._meetings: list[Meeting] = []  # of this turn: what came of the games of each learner against each opponent
        self._parents: Mapping[str, str | None] = {}  # of players that go on from others since this turn
        self._copied: tuple[str, ...] = ()  # players that take over this turn's learner's actors
        self._earlier: list[CurvePoint] = []  # of the phase's learner, from its turns before this one
        self._handed_over = False  # whether the turn ended its learner's turn of leapfrog
        self._histories: Mapping[str, list[Snapshot]] = {}  # of the players of the turn, oldest first
        self._log: list[Meeting] = []  # of the store's, as far as it was read: by them lives end
        self._frozen: dict[str, bytes] = {}  # players whose life the turn has ended, as they were then
        self.interrupted = False  # whether the last turn was told to stop before its end
        self._begun_anew = 0.0  # share of the worlds whose episodes were broken off for this turn's opponents
        stagger = config.training.stagger
        self._reset, self._restart = make_reset(arena, stagger), make_restart(arena, stagger)
        chunk, privileged = config.learner.sequence, config.learner.critic_input == "privileged"
        self._rollout = Compiled(make_rollout(arena, config.training.rollout, chunk, privileged), arena)
        self._shapes = self._architectures()
        self._each = beside(list(self.learners.values()))
        self._device = next(iter(self.learners.values())).device
        self._room = memory.room(self._device)

    def turn(self, store: Store, turn: TrainingTurn, stop: Callable[[], bool]) -> Iterator[Progress]:
        """Learn, and yield after every iteration; end early, between two iterations, when `stop()` says so.

        The turn also ends with its phase, where that is counted in environment steps: how many an iteration has depends
        on the worlds of this machine. Raises PlayerDiverged where a player's learning went bad.
        """
        self._restore(store, turn)
        self.interrupted = False
        phase = store.phases(next(iter(self.players.values())).league).get(turn.group)
        phase = phase if phase is not None and phase.number == turn.phase else None
        if turn.iterations == 0:
            self._begin(store, turn)
            compare(self.learners)
            return
        if phase is not None and "score" in phase.until:
            (learner,) = phase.learners
            self._earlier = store.curves(phase.league, learner, after=phase.since.get(learner, 0))
        lineup = self._lineup(store, turn)
        worlds, collect = self._prepare(lineup, turn)
        began, before, steps = time.monotonic(), dict(self.counters), 0
        met = {name: np.zeros((lineup.groups, 4)) for name in turn.learners}

        for left in reversed(range(turn.iterations)):
            worlds, trajectory = collect(self._crews(lineup), worlds, self._key(turn, "rollout"))
            figures = self._learn(turn, trajectory, lineup)
            for name in turn.learners:
                met[name] += results(trajectory, self.players[name].team, lineup.groups, self.together.add)

            steps += lineup.worlds * self.together.size * self.config.training.rollout
            elapsed = self.together.first(time.monotonic() - began)
            points = tuple(self._count(name, before[name], steps, elapsed, figures[name]) for name in turn.learners)
            self._points.extend(points)
            yield Progress({name: self.counters[name] for name in turn.learners}, steps / elapsed, points)
            if self._enough(turn, before) or self._is_over(phase) or self._timed_out(turn):
                break
            if left and self.together.first(stop()):
                self.interrupted = True
                break
        self._worlds[turn.group] = worlds, lineup.seated
        for name, won in met.items():
            self._meetings += lineup.meetings(self.players[name], self.counters[name].iteration, won)
        if phase is not None and self._is_over(phase):
            kind = self.config.training.schedule.kind
            self._handed_over = kind == "leapfrog"
            if kind == "ladder":
                self._copy(store, turn, phase)
        self._end_lives(store, turn)
        compare(self.learners)

    def commit(self, store: Store, lease: Lease, turn: TrainingTurn) -> None:
        """Write the turn's checkpoints, curves, games, and snapshots where they are due; end the job: one transaction.

        Raises LeaseLost if the job, or a player, has meanwhile gone on elsewhere; then nothing was written.
        """
        learnt = [*turn.learners, *(self._resting(turn) if self.config.training.resting_critics else self._copied)]
        key = ArenaKey(self.arena.name, self.arena.config_hash, self.arena.engine.name)
        checkpoints, snapshots = [], []
        for name in learnt:
            learner, at = self.learners[name], self.counters[name]
            fades = self._fading[name]
            digest = store.blobs.put(arrays.to_bytes(learner.state() | (fades.state() if fades else {})))
            league = self.players[name].league
            checkpoints.append(Checkpoint(league, name, digest, at.steps, at.iteration, at.seconds, key))
        for name in filter(None, turn.present):
            snapshots.extend(self._snapshot(store, self.players[name], key, turn))
        bases = {name: turn.bases[name] for name in learnt}
        keep = self.config.storage.checkpoints
        store.finish(
            lease, bases=bases, checkpoints=checkpoints, snapshots=snapshots, curves=self._points,
            meetings=self._meetings, keep=keep,
        )  # fmt: skip
        self._points, self._meetings = [], []
        self._at |= {checkpoint.player: checkpoint.digest for checkpoint in checkpoints}

    def too_large(self) -> memory.TooLarge:
        """What to say where a turn ran out of memory: what it needed, by XLA's count and the numbers of a batch."""
        at_once = len(self.arena.teams) if self._device.type == "cpu" else 1
        needed = self._rollout.bytes + memory.learning(self.config, self.arena, self.asked, at_once)
        worlds = self.asked * self.together.size
        return memory.TooLarge(memory.words(self.config, worlds, needed, self._room))

    # An iteration ----------------------------------------------------------------------------------------------------

    def _learn(self, turn: TrainingTurn, trajectory: Trajectory, lineup: Lineup) -> dict[str, dict[str, float]]:
        """One HAPPO update of every learner, and what the iteration was like for each; critics of who rests follow.

        Raises PlayerDiverged. Where no world stayed sound nobody can learn: then it is whose robots alone went bad.
        """
        resting = self._resting(turn) if self.config.training.resting_critics else []
        resting = [name for name in resting if lineup.teaches(name)]
        names = [*turn.learners, *resting]
        batches = [self._batch(name, trajectory, lineup) for name in names]
        figures = {
            name: outcomes(trajectory, self.players[name].team, lineup.worlds_of(name), self.together.add)
            for name in turn.learners
        }
        taught = list(self._each(self._update, names, batches, [name in resting for name in names]))
        self._recall(names, lineup)
        diverged: dict[str, object] = {}
        for name, losses in zip(names, taught, strict=True):
            if isinstance(losses, Diverged):
                diverged[name] = losses
            elif name in figures:
                if not losses:
                    diverged.setdefault("", f"physics became unstable in every world of {name}")
                figures[name] |= {**losses, "past_share": lineup.past_share(name)}
        if "" in diverged and len(diverged) == 1:
            culprit = max(turn.learners, key=lambda name: figures[name]["own_voids"])
            raise PlayerDiverged(culprit, diverged[""])
        for name in filter(None, diverged):
            raise PlayerDiverged(name, diverged[name])
        return figures

    def _update(self, name: str, batch: Batch, rests: bool) -> dict[str, float] | Diverged:
        """A player's update, of its critic alone where it rests; it touches nothing that another player has."""
        learner = self.learners[name]
        try:
            return learner.update_critic_only(batch) if rests else learner.update(batch)
        except Diverged as error:
            return error

    def _recall(self, names: Sequence[str], lineup: Lineup) -> None:
        """Keep what critics remember of the worlds that they have just learnt from, for the rollout that goes on there.

        Of other worlds they remember nothing, and nor does a critic that did not learn now: it has missed too much.
        Like the worlds this is no part of a checkpoint: who goes on from one begins in fresh worlds.
        """
        for name in filter(None, lineup.turn.present):
            remembered = self.learners[name].remembered if name in names else ()
            self._recalled[name] = everywhere(remembered, lineup.worlds_of(name), lineup.worlds)

    def _batch(self, name: str, trajectory: Trajectory, lineup: Lineup) -> Batch:
        team, sees = self.players[name].team, self.config.learner.critic_input
        return team_batch(
            trajectory, self.arena.teams[team], team, lineup.worlds_of(name), self._shaping(name),
            others=others(self.config, self.arena, team), privileged=sees == "privileged",
            common=self.arena.teams if sees == "same" else (), recalled=self._recalled.get(name, ()),
        )  # fmt: skip

    def _count(
        self, name: str, before: Counters, steps: int, elapsed: float, figures: Mapping[str, float]
    ) -> CurvePoint:
        """Move a player's counters on by one iteration."""
        at = self.counters[name]
        now = Counters(at.iteration + 1, before.steps + steps, before.seconds + elapsed)
        self.counters[name] = now
        if fades := self._fading[name]:
            fades.note(figures)
        values = {
            **figures, "steps_per_second": steps / elapsed, "shaping_weight": self._shaping(name),
            "begun_anew": self._begun_anew if at == before else 0.0,
        }  # fmt: skip
        return CurvePoint(self.players[name].league, name, now.iteration, now.steps, now.seconds, values)

    def _crews(self, lineup: Lineup) -> dict[str, Crew]:
        now = {name: to_jax(self.learners[name].policies()) for name in lineup.turn.present if name}
        return lineup.crews(now, self._shapes)

    def _architectures(self) -> dict[str, list]:
        """Actors by agent of every player of the agent's team: whoever sits there, the compiled shape is the same."""
        actors = {name: to_jax(learner.policies()) for name, learner in self.learners.items()}
        return {
            agent.name: [actors[p.name][i] for p in self.players.values() if p.team == t]
            for t, team in enumerate(self.arena.teams)
            for i, agent in enumerate(team.agents)
        }

    def _shaping(self, name: str) -> float:
        """Weight of a player's dense reward as it stands."""
        fades = self._fading[name]
        begun = lives.fresh_since(self._role(name), self.config.seed, name, self._histories[name])
        return fades.weight if fades else fading.by_steps(self.config.training, self.counters[name].steps - begun)

    # Before and after ------------------------------------------------------------------------------------------------

    def _resting(self, turn: TrainingTurn) -> list[str]:
        """Players that sit in the turn and rest; critics of those that are paused or never learn stand still too."""
        rest = [name for name in turn.present if name and name not in turn.learners and self._role(name).learns]
        return [name for name in rest if self.players[name].paused is None]

    def _begin(self, store: Store, turn: TrainingTurn) -> None:
        """Make the players of the turn: as their seeds have them, or from players of the leagues before this one."""
        if self.config.after:
            found = heirs.of(store, list(self.players.values()), self.config.after, self.config.learner.critic_input)
            self._parents = {name: heirs.start(store, self.learners[name], found[name]) for name in turn.learners}

    def _copy(self, store: Store, turn: TrainingTurn, phase: Phase) -> None:
        """Ladder: the turn ends its phase, and the players that rest take over the learner's actors.

        They are written with the learner's checkpoint, in the one transaction that makes the phase be over: so each
        phase is followed by one copy, however often the league is killed. What they have learnt from is now what the
        learner has; their iterations move on by the phase's, since a checkpoint is newest, and a snapshot new, by them.
        Critics, optimisers and random numbers stay their own.
        """
        (learner,) = turn.learners
        state, now = self.learners[learner].state(), self.counters[learner]
        self._copied = tuple(self._resting(turn))
        for name in self._copied:
            agents, own = range(len(self.arena.teams[self.players[name].team].agents)), self.counters[name]
            self.learners[name].inherit([(state, i) for i in agents], None)
            iteration = own.iteration + now.iteration - phase.since.get(learner, 0)
            self.counters[name] = Counters(iteration, max(own.steps, now.steps), max(own.seconds, now.seconds))
            mine, theirs = self._fading[name], self._fading[learner]
            if mine and theirs:
                mine.follow(theirs)
        self._parents = dict.fromkeys(self._copied, store.snapshots(phase.league, learner)[-1].name)
        self._worlds.pop(turn.group)  # an episode against two opponents in turn is neither's game

    def _end_lives(self, store: Store, turn: TrainingTurn) -> None:
        """Freeze the learners whose life is over, and only then begin anew with those whose role and dice have it so.

        Snapshot and new checkpoint are written in the turn's one transaction. What was frozen are bytes, which nothing
        that is learnt later can change.
        """
        own = [self.players[name] for name in turn.learners if self._role(name).has_lives]
        if not own:
            return
        league, seed = own[0].league, self.config.seed
        self._log += store.meetings(league, self._log[-1].id if self._log else 0)
        games = [*self._log, *self._meetings]
        standing = Standing(list(self.players.values()), store.snapshots(league), meetings=games)
        found = {p.name: lives.life(self._role(p.name), standing, p, self.counters[p.name].steps) for p in own}
        over = [name for name, life in found.items() if life is not None and life.over]
        for name in self.together.first(over):
            self._frozen[name] = self._freeze(name)
            role, player, at = self._role(name), self.players[name], self.counters[name].iteration
            if role.reset_after(seed, name, at):
                source = lives.source(role, player, None, standing)
                begin_anew(self.learners[name], self.config, self.arena, player, store, source, at, self.together)
                if role.reset == "initial":
                    self._fading[name] = fading.begun(self.config.training, len(self.arena.teams))
                self._worlds.pop(turn.group, None)  # an episode that two policies played is neither's

    def _role(self, name: str) -> Role:
        return self.config.role(self.players[name].role)

    def _restore(self, store: Store, turn: TrainingTurn) -> None:
        """Bring every player of the turn to the checkpoint that the turn starts from, unless it stands there."""
        self._points, self._meetings, self._parents, self._copied = [], [], {}, ()
        self._earlier, self._handed_over, self._frozen = [], False, {}
        self._at = self.together.first(self._at)
        league = next(iter(self.players.values())).league
        self.players = {player.name: player for player in store.players(league)}  # one may have been paused
        self._histories = {name: store.snapshots(league, name) for name in turn.present if name}
        for name, digest in turn.bases.items():
            player = self.players[name]
            if digest and (digest != self._at[name] or turn.dice):
                state = arrays.from_bytes(store.blobs.get(digest))
                self.learners[name].load(state)
                if fades := self._fading[name]:
                    fades.load(state)
                self._worlds.pop(turn.group, None)  # they belong to a history that is not the store's
                if turn.dice:
                    self.learners[name].rng.manual_seed(crc32(f"{self.config.seed}/{name}/{turn.dice}".encode()))
            self._at[name] = digest
            kept = store.checkpoint(player.league, name)
            self.counters[name] = Counters(kept.iteration, kept.step, kept.seconds) if kept else Counters()

    def _lineup(self, store: Store, turn: TrainingTurn) -> Lineup:
        alone = "" in turn.present
        groups = {n: 0 if alone else self.config.opponents(self.players[n]).split().present for n in turn.learners}
        present = max(groups.values())
        if not any(turn.past.values()):
            present = 1  # without past opponents all groups would be alike
        aloof = [name for name, wanted in groups.items() if not wanted and turn.past.get(name)]
        league = next(iter(self.players.values())).league
        return Lineup(turn, present, self.asked, store, league, self.arena, aloof)

    def _prepare(self, lineup: Lineup, turn: TrainingTurn) -> tuple[Worlds, Callable]:
        """Worlds and the compiled rollout, so that neither counts as training time.

        Where somebody else sits than in the turn before, an episode must not go on with a new opponent: those worlds
        begin anew. Which of the group's worlds learn from whom may have changed too; that is seen as other seats.
        """
        self._begun_anew = 0.0
        worlds, before = self._worlds.pop(turn.group, (None, []))
        if worlds is not None and len(before) == lineup.groups and not self.config.deterministic:
            changed = lineup.changed(before)
            if changed.any():
                keys = jax.random.split(self._key(turn, "restart"), lineup.worlds)
                worlds = self._restart(worlds, keys, jnp.asarray(changed))
                self._begun_anew = float(changed.mean())
        else:
            keys = jax.random.split(self._key(turn, "worlds"), lineup.worlds)
            worlds = jax.block_until_ready(self._reset(keys))
            self._recalled |= {name: [] for name in turn.present}
        crews = self._crews(lineup)
        worlds = remembering(worlds, crews)
        return worlds, self._rollout.ready(crews, worlds, jax.random.key(0))

    def _key(self, turn: TrainingTurn, purpose: str) -> Array:
        """A key for one purpose and moment, the same in every process and after every restart."""
        moment = sum(self.counters[name].iteration for name in turn.present if name)
        key = random_key(self.config.seed, f"{turn.group}/{turn.dice}/{purpose}", moment)
        return key if self.together.size == 1 else jax.random.fold_in(key, self.together.rank)

    def _enough(self, turn: TrainingTurn, before: Mapping[str, Counters]) -> bool:
        """Whether the turn should end here: the group's budget is spent, or a milestone of the clock was passed."""
        if self._spent(turn):
            return True
        marks = self.config.milestones.values()
        return any(before[n].seconds < mark <= self.counters[n].seconds for n in turn.learners for mark in marks)

    def _is_over(self, phase: Phase | None) -> bool:
        """Whether the phase's learner has learnt as much as the phase asks for; the plan finds the same afterwards."""
        if phase is None:
            return False
        at = {name: Learnt(c.iteration, c.steps) for name, c in self.counters.items()}
        if "score" in phase.until:
            (learner,) = phase.learners
            low = turn_score(episode_scores([*self._earlier, *self._points])).low
            at[learner] = at[learner]._replace(low=low)
        return remaining(phase, at) == 0

    def _spent(self, turn: TrainingTurn) -> bool:
        """Whether the group has had its budget; `plan.spent` says the same of what the store holds."""
        total = sum if self.config.training.schedule.adds_up else max
        at = [self.counters[name] for name in turn.present if name]
        seconds = 0.0 if self.config.deterministic else total([c.seconds for c in at])
        return self.config.budget.spent(seconds, total([c.steps for c in at]))

    def _timed_out(self, turn: TrainingTurn) -> bool:
        """Whether the life of one who learns has lasted for as many steps as its role gives it."""
        return any(
            lives.steps_left(self._role(name), self._histories[name][-1], self.counters[name].steps) == 0
            for name in turn.learners
        )

    def _snapshot(self, store: Store, player: Player, key: ArenaKey, turn: TrainingTurn) -> list[Snapshot]:
        """The player frozen as it is now, if that is due: at the start, in between, when the budget is spent.

        And when its turn of leapfrog or its life ends.
        """
        standing = Standing(list(self.players.values()), store.snapshots(player.league))
        kept = standing.history(player.name)
        if kept and not self._snapshot_due(player, kept[-1], turn):
            return []
        at = self.counters[player.name]
        actors = self._frozen.get(player.name) or self._freeze(player.name)
        gone_on_from = lives.parent(self._role(player.name), self.config.seed, player, standing)
        parent = self._parents.get(player.name, gone_on_from)
        return [
            Snapshot(
                player.league, f"{player.name}@{at.iteration}", store.blobs.put(actors), player.roster,
                player.name, parent=parent, initial=not kept, arena=key,
                settings=configuration.dumps(self.config), step=at.steps, iteration=at.iteration, seconds=at.seconds,
            )
        ]  # fmt: skip

    def _freeze(self, name: str) -> bytes:
        """A player's actors as they are now."""
        policies = self.learners[name].policies()
        return freeze([{key: tensor.cpu().numpy() for key, tensor in policy.items()} for policy in policies])

    def _snapshot_due(self, player: Player, last: Snapshot, turn: TrainingTurn) -> bool:
        """Whether it is. Who may begin anew is frozen when its life ends and never else: by that a life is told."""
        now, role = self.counters[player.name], self._role(player.name)
        if now.iteration == last.iteration:
            return False
        if player.name in self._frozen or role.begins_anew:
            return player.name in self._frozen
        due = next_due(last.iteration, self.config.training.snapshots_per_doubling)
        on_axis = now.iteration >= due and not role.has_lives
        marks = self.config.milestones.values()
        passed = any(last.seconds < mark <= now.seconds for mark in marks)
        hands_over = self._handed_over and player.name in turn.learners
        return on_axis or passed or hands_over or self._spent(turn)


def random_key(seed: int, purpose: str, number: int) -> Array:
    """A key for one purpose, the same in every process and after every restart."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), crc32(purpose.encode())), number)
