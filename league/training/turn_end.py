"""End of a training turn: the conditions that end it, and the copies, resets and snapshots that follow.

All of it follows from the players' states at the end of the turn, and is written with their checkpoints in its one
transaction (`league/training/trainer.py`).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

from agents.learner.happo import HappoLearner
from league.config import experiment as configuration
from league.scheduling import player_resets
from league.snapshots.transfer import warm_start
from league.state.jobs import TrainingTurn
from league.state.league_state import LeagueState
from league.state.recent_curves import episode_scores
from league.system.provenance import made_by
from league.training.learner_pool import Counters, LearnerPool
from matchmaking.schedule import LearningCounts, next_due, phase_score, remaining
from storage.records import ArenaKey, CurvePoint, Meeting, Phase, Player, Snapshot
from storage.store import Store


class TurnFinalizer:
    """Decides when one turn ends, makes its copies and resets, and returns the snapshots that `commit` writes."""

    def __init__(self, pool: LearnerPool, turn: TrainingTurn, store: Store):
        self.pool, self.turn, self.config = pool, turn, pool.config
        self.copied: tuple[str, ...] = ()  # players that take over the learner's actors
        self._before = dict(pool.counters)
        phase = store.phases(pool.league).get(turn.group)
        self._phase = phase if phase is not None and phase.number == turn.phase else None
        self._earlier: list[CurvePoint] = []  # of the phase's learner, from its turns before this one
        if self._phase is not None and "score" in self._phase.until:
            (learner,) = self._phase.learners
            self._earlier = store.curves(pool.league, learner, after=self._phase.since.get(learner, 0))
        self._handed_over = False  # whether the turn ends its learner's turn of leapfrog
        # Parents of players that continue from others since this turn:
        self._parents: dict[str, str | None] = {name: newest for name, (*_, newest) in turn.copies.items()}
        self._frozen: dict[str, bytes] = {}  # actors of players whose generation the turn ends, at that moment

    # Conditions ------------------------------------------------------------------------------------------------------

    def reached(self, points: Sequence[CurvePoint]) -> bool:
        """Return whether the turn should end now, by the learning curves of the turn so far.

        It ends if the group's budget is spent, the phase or a generation is over, or a milestone of training time was
        passed.
        """
        return self.pool.spent(self.turn) or self._marked() or self._is_over(points) or self._timed_out()

    def _marked(self) -> bool:
        marks, now = self._marks, self.pool.counters
        return any(self._before[n].seconds < mark <= now[n].seconds for n in self.turn.learners for mark in marks)

    @property
    def _marks(self) -> tuple[float, ...]:
        return tuple(self.config.milestones.values())

    def _is_over(self, points: Sequence[CurvePoint]) -> bool:
        """Return whether the phase is complete; the turn scheduler comes to the same result afterwards."""
        phase = self._phase
        if phase is None:
            return False
        at = {name: LearningCounts(c.iteration, c.steps) for name, c in self.pool.counters.items()}
        if "score" in phase.until:
            (learner,) = phase.learners
            low = phase_score(episode_scores([*self._earlier, *points])).low
            at[learner] = at[learner]._replace(low=low)
        return remaining(phase, at) == 0

    def _timed_out(self) -> bool:
        """Return whether a learner's generation has lasted for the steps of its role's timeout."""
        pool = self.pool
        return any(
            pool.role(name).steps_left(pool.histories[name][-1].step, pool.counters[name].steps) == 0
            for name in self.turn.learners
        )

    # Consequences ----------------------------------------------------------------------------------------------------

    def begin(self, store: Store) -> None:
        """Make the players of the turn: initialised by their seeds, or by warm starts from the preceding leagues."""
        config, players = self.config, list(self.pool.players.values())
        if config.every_after:
            found = warm_start.of_config(store, players, config)
            for name in self.turn.learners:
                learner = self.pool.learners[name]
                if isinstance(learner, HappoLearner):  # others start from nothing: `validate` refuses them an `after`
                    fitted = warm_start.fits_of(store, config, self.pool.arena, self.pool.players[name], found[name])
                    self._parents[name] = warm_start.start(store, learner, found[name], fitted)

    def close(self, store: Store, points: Sequence[CurvePoint], meetings: Sequence[Meeting]) -> bool:
        """Make the copies and resets that follow from the turn's learning curves and games.

        Return whether a player continues with another policy. Then its worlds must restart, because no episode may be
        played by two policies.
        """
        if self._phase is not None and self._is_over(points):
            kind = self.config.training.schedule.kind
            self._handed_over = kind == "leapfrog"
            if kind == "ladder":
                self._copy(store, self._phase)
        return self._end_generations(store, meetings) or bool(self.copied)

    def _copy(self, store: Store, phase: Phase) -> None:
        """Copy the learner's actors to the resting players, at the end of a phase of the ladder schedule.

        They are written with the learner's checkpoint, in the one transaction that completes the phase, so exactly one
        copy follows each phase, however often the league is killed. Their steps and seconds become at least those of
        the learner. Their iterations advance by those of the phase, because iterations order checkpoints and snapshots.
        """
        (learner,) = self.turn.learners
        counters = self.pool.counters
        now, done = counters[learner], counters[learner].iteration - phase.since.get(learner, 0)
        self.copied = tuple(self.pool.resting(self.turn))
        for name in self.copied:
            self.pool.take_over(name, learner)
            own = counters[name]
            counters[name] = Counters(own.iteration + done, max(own.steps, now.steps), max(own.seconds, now.seconds))
        self._parents |= dict.fromkeys(self.copied, store.snapshots(phase.league, learner)[-1].name)

    def _end_generations(self, store: Store, meetings: Sequence[Meeting]) -> bool:
        """Keep the actors of learners whose generation is over, then reset those that their role resets.

        Some roles reset at random, by the league's seed. `meetings` are those of the turn. Snapshot and new checkpoint
        are written in the turn's one transaction. Return whether any player was reset.
        """
        pool = self.pool
        own = [pool.players[name] for name in self.turn.learners if pool.role(name).has_generations]
        if not own:
            return False
        state = LeagueState(list(pool.players.values()), store.snapshots(pool.league, brief=True))
        living = [name for name in pool.players if pool.role(name).has_generations and state.history(name)]
        begun = {name: state.history(name)[-1].iteration for name in living}
        state = replace(state, meetings=[*pool.meetings(store, begun), *meetings])
        found = {
            p.name: player_resets.current_generation(pool.role(p.name), state, p, pool.counters[p.name].steps)
            for p in own
        }
        over = [name for name, each in found.items() if each is not None and each.over]
        reset = False
        for name in pool.comm.broadcast(over):
            self._frozen[name] = pool.freeze(name)
            role = pool.role(name)
            if role.reset_after(self.config.seed, name, pool.counters[name].iteration):
                pool.reset_learner(store, name, player_resets.source(role, pool.players[name], None, state))
                reset = True
        return reset

    def snapshots(self, store: Store, key: ArenaKey) -> list[Snapshot]:
        """Return the snapshots of the turn's players that are due: the first, by iteration, and at an end.

        An end is that of the budget, of a turn of leapfrog or of a generation. Their bytes are in the store, and the
        rows are still to be written.
        """
        pool = self.pool
        state = LeagueState(list(pool.players.values()), store.snapshots(pool.league, brief=True))
        found = [self._snapshot(store, pool.players[name], key, state) for name in self.turn.present if name]
        return [snapshot for snapshot in found if snapshot is not None]

    def _snapshot(self, store: Store, player: Player, key: ArenaKey, state: LeagueState) -> Snapshot | None:
        kept, at = state.history(player.name), self.pool.counters[player.name]
        if kept and not self._due(player, kept[-1]):
            return None
        actors = self._frozen.get(player.name) or self.pool.freeze(player.name)
        continued_from = player_resets.parent(self.pool.role(player.name), self.config.seed, player, state)
        return Snapshot(
            player.league, f"{player.name}@{at.iteration}", store.blobs.put(actors), player.roster, player.name,
            parent=self._parents.get(player.name, continued_from), initial=not kept, arena=key,
            settings=self._settings, step=at.steps, iteration=at.iteration,
            seconds=at.seconds,
        )  # fmt: skip

    @cached_property
    def _settings(self) -> str:
        """The configuration as text, with the code that runs, as each snapshot keeps it: short, for there are many."""
        return configuration.dumps(self.config, comments=False) + made_by()

    def _due(self, player: Player, last: Snapshot) -> bool:
        """Return whether a snapshot is due.

        A player that can be reset is snapshotted only at the end of a generation, so its snapshots mark its
        generations. A player that copies another is snapshotted with the turn, because the snapshot's parent is the
        record of the copy.
        """
        now, role = self.pool.counters[player.name], self.pool.role(player.name)
        if now.iteration == last.iteration:
            return False
        if player.name in self.turn.copies:
            return True
        if player.name in self._frozen or role.can_reset:
            return player.name in self._frozen
        due = next_due(last.iteration, self.config.training.snapshots_per_doubling)
        due_by_iteration = now.iteration >= due and not role.has_generations
        passed = any(last.seconds < mark <= now.seconds for mark in self._marks)
        hands_over = self._handed_over and player.name in self.turn.learners
        return due_by_iteration or passed or hands_over or self.pool.spent(self.turn)
