"""When a training turn ends, and what happens then: who takes over whose policy, whose life ends, who is frozen.

All of it follows from the players as the turn leaves them, and is written with their checkpoints in its one
transaction (`league/train.py`).
"""

from collections.abc import Sequence

from league import heirs, lives
from league.config import experiment as configuration
from league.jobs import TrainingTurn
from league.squad import Counters, Squad
from league.standing import Standing, episode_scores
from matchmaking.schedule import Learnt, next_due, remaining, turn_score
from storage.records import ArenaKey, CurvePoint, Meeting, Phase, Player, Snapshot
from storage.store import Store


class Ending:
    """How one turn ends, and what `commit` has to know of it."""

    def __init__(self, squad: Squad, turn: TrainingTurn, store: Store):
        self.squad, self.turn, self.config = squad, turn, squad.config
        self.copied: tuple[str, ...] = ()  # players that take over the learner's actors
        self._before = dict(squad.counters)
        phase = store.phases(squad.league).get(turn.group)
        self._phase = phase if phase is not None and phase.number == turn.phase else None
        self._earlier: list[CurvePoint] = []  # of the phase's learner, from its turns before this one
        if self._phase is not None and "score" in self._phase.until:
            (learner,) = self._phase.learners
            self._earlier = store.curves(squad.league, learner, after=self._phase.since.get(learner, 0))
        self._handed_over = False  # whether the turn ends its learner's turn of leapfrog
        # Of players that go on from others since this turn:
        self._parents: dict[str, str | None] = {name: theirs for name, (*_, theirs) in turn.copies.items()}
        self._frozen: dict[str, bytes] = {}  # players whose life the turn ends, as they were then

    # When ------------------------------------------------------------------------------------------------------------

    def reached(self, points: Sequence[CurvePoint]) -> bool:
        """Whether the turn should end now, by the learning curves of the turn so far.

        The group's budget is spent, the phase or a life is over, or a milestone of the clock was passed.
        """
        return self.squad.spent(self.turn) or self._marked() or self._is_over(points) or self._timed_out()

    def _marked(self) -> bool:
        marks, now = self._marks, self.squad.counters
        return any(self._before[n].seconds < mark <= now[n].seconds for n in self.turn.learners for mark in marks)

    @property
    def _marks(self) -> tuple[float, ...]:
        return tuple(self.config.milestones.values())

    def _is_over(self, points: Sequence[CurvePoint]) -> bool:
        """Whether the phase's learner has learnt as much as the phase asks for; the plan finds the same afterwards."""
        phase = self._phase
        if phase is None:
            return False
        at = {name: Learnt(c.iteration, c.steps) for name, c in self.squad.counters.items()}
        if "score" in phase.until:
            (learner,) = phase.learners
            low = turn_score(episode_scores([*self._earlier, *points])).low
            at[learner] = at[learner]._replace(low=low)
        return remaining(phase, at) == 0

    def _timed_out(self) -> bool:
        """Whether the life of one who learns has lasted for as many steps as its role gives it."""
        squad = self.squad
        return any(
            lives.steps_left(squad.role(name), squad.histories[name][-1], squad.counters[name].steps) == 0
            for name in self.turn.learners
        )

    # What happens ----------------------------------------------------------------------------------------------------

    def begin(self, store: Store) -> None:
        """Make the players of the turn: as their seeds have them, or from players of the leagues before this one."""
        config, players = self.config, list(self.squad.players.values())
        if config.after:
            found = heirs.of(store, players, config.after, config.learner.critic_input)
            learners = self.squad.learners
            self._parents = {name: heirs.start(store, learners[name], found[name]) for name in self.turn.learners}

    def close(self, store: Store, points: Sequence[CurvePoint], meetings: Sequence[Meeting]) -> bool:
        """Do what follows from the turn's learning, by its learning curves and games.

        True where somebody goes on with another policy: an episode that two policies play is neither's.
        """
        if self._phase is not None and self._is_over(points):
            kind = self.config.training.schedule.kind
            self._handed_over = kind == "leapfrog"
            if kind == "ladder":
                self._copy(store, self._phase)
        return self._end_lives(store, meetings) or bool(self.copied)

    def _copy(self, store: Store, phase: Phase) -> None:
        """Ladder: the turn ends its phase, and the players that rest take over the learner's actors.

        They are written with the learner's checkpoint, in the one transaction that makes the phase be over: so each
        phase is followed by one copy, however often the league is killed. What they have learnt from is now what the
        learner has; their iterations move on by the phase's, since a checkpoint is newest, and a snapshot new, by them.
        """
        (learner,) = self.turn.learners
        counters = self.squad.counters
        now, done = counters[learner], counters[learner].iteration - phase.since.get(learner, 0)
        self.copied = tuple(self.squad.resting(self.turn))
        for name in self.copied:
            self.squad.take_over(name, learner)
            own = counters[name]
            counters[name] = Counters(own.iteration + done, max(own.steps, now.steps), max(own.seconds, now.seconds))
        self._parents |= dict.fromkeys(self.copied, store.snapshots(phase.league, learner)[-1].name)

    def _end_lives(self, store: Store, meetings: Sequence[Meeting]) -> bool:
        """Freeze the learners whose life is over, and only then begin anew with those whose role and dice have it so.

        `meetings` are those of the turn. Snapshot and new checkpoint are written in its one transaction. True where
        somebody has begun anew.
        """
        squad = self.squad
        own = [squad.players[name] for name in self.turn.learners if squad.role(name).has_lives]
        if not own:
            return False
        games = [*squad.meetings(store), *meetings]
        standing = Standing(list(squad.players.values()), store.snapshots(squad.league), meetings=games)
        found = {p.name: lives.life(squad.role(p.name), standing, p, squad.counters[p.name].steps) for p in own}
        over = [name for name, life in found.items() if life is not None and life.over]
        anew = False
        for name in squad.together.first(over):
            self._frozen[name] = squad.freeze(name)
            role = squad.role(name)
            if role.reset_after(self.config.seed, name, squad.counters[name].iteration):
                squad.begin_anew(store, name, lives.source(role, squad.players[name], None, standing))
                anew = True
        return anew

    def snapshots(self, store: Store, key: ArenaKey) -> list[Snapshot]:
        """The players of the turn frozen as they are now, where that is due: at the start, in between, at the end.

        The end is that of the budget, of a turn of leapfrog or of a life. Their bytes are in the store, the rows are to
        be written.
        """
        squad = self.squad
        standing = Standing(list(squad.players.values()), store.snapshots(squad.league))
        found = [self._snapshot(store, squad.players[name], key, standing) for name in self.turn.present if name]
        return [snapshot for snapshot in found if snapshot is not None]

    def _snapshot(self, store: Store, player: Player, key: ArenaKey, standing: Standing) -> Snapshot | None:
        kept, at = standing.history(player.name), self.squad.counters[player.name]
        if kept and not self._due(player, kept[-1]):
            return None
        actors = self._frozen.get(player.name) or self.squad.freeze(player.name)
        gone_on_from = lives.parent(self.squad.role(player.name), self.config.seed, player, standing)
        return Snapshot(
            player.league, f"{player.name}@{at.iteration}", store.blobs.put(actors), player.roster, player.name,
            parent=self._parents.get(player.name, gone_on_from), initial=not kept, arena=key,
            settings=configuration.dumps(self.config), step=at.steps, iteration=at.iteration, seconds=at.seconds,
        )  # fmt: skip

    def _due(self, player: Player, last: Snapshot) -> bool:
        """Whether it is. Who may begin anew is frozen when its life ends and never else: by that a life is told.

        Who copies another is frozen with the turn, for its snapshot's parent is what tells of the copy.
        """
        now, role = self.squad.counters[player.name], self.squad.role(player.name)
        if now.iteration == last.iteration:
            return False
        if player.name in self.turn.copies:
            return True
        if player.name in self._frozen or role.begins_anew:
            return player.name in self._frozen
        due = next_due(last.iteration, self.config.training.snapshots_per_doubling)
        on_axis = now.iteration >= due and not role.has_lives
        passed = any(last.seconds < mark <= now.seconds for mark in self._marks)
        hands_over = self._handed_over and player.name in self.turn.learners
        return on_axis or passed or hands_over or self.squad.spent(self.turn)
