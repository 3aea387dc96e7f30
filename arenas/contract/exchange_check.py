"""Check of teams that an arena declares exchangeable, over an episode of play and by scores.

In each world all teams act by one policy: at random, or by a script that all robots know. Several times per episode,
and before each decision in which a world ends, the situation is exchanged (`Game.exchange`) and both versions take one
decision. Then each team must observe and get what the team whose place it has observed and got in the original. Of
three and more equal teams the first two change places, and all move on by one: every permutation is made of these. Both
versions use the default model fields, because the situation is exchanged and not the robots' masses.

The starts of episodes can also favour a side, and exchanges do not reveal that. Therefore scores of one policy against
itself are counted. If they lean to one side, or only one side has won, more episodes are played, until chance explains
the lean well or is practically excluded. Draws say nothing about a lean, so the first observations of exchanged agents
are compared too.
"""

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from arenas.arena import Arena
from arenas.contract.check_run import CLOSE, WORLDS, CheckRun, difference
from arenas.game import Game
from arenas.physics.engine import VARIABLE
from arenas.rosters import bare
from arenas.state import State, Verdict

EXCHANGES = 8  # per episode, besides those before a decision in which a world ends
EPISODES = 8  # of WORLDS worlds at most
MOVED = 1e-4  # m, rad, m/s and rad/s: tolerance for bodies of exchanged worlds after a decision
P_PLAY_ON, P_UNEQUAL = (
    0.2,
    1e-4,
)  # two-sided p-values: below the first more is played, below the second the sides are unequal
STARTS = 32  # resets of WORLDS worlds whose first observations are compared
LEAN = 6.0  # standard deviations; in a fair arena a number leans so far with a chance below 2 exp(-18)


class Step(NamedTuple):
    """One decision of play."""

    before: State
    actions: dict[str, Array]
    after: State


def exchangeable(arena: Arena) -> list[list[int]]:
    """Return the teams that can change places, in sets of equal agents; none if the arena does not declare it."""
    if not arena.exchangeable:
        return []
    rosters = [bare(team.roster) for team in arena.teams]
    sets = [[i for i, own in enumerate(rosters) if own == roster] for roster in dict.fromkeys(rosters)]
    return [each for each in sets if len(each) > 1]


def problem(run: CheckRun) -> str:
    """Describe why the teams are not exchangeable; empty if nothing shows it."""
    exchanged = [_ExchangedWorlds(run, order) for order in _orders(run.arena)]
    if not exchanged:
        return ""
    every, last = max(1, run.arena.timing.decisions // EXCHANGES), run.first
    for number, (before, actions, after) in enumerate(_play(run, 0)):
        ends, last = np.asarray(after.done & ~before.done).any(), after
        if ends or number % every == 0:
            for worlds in exchanged:
                if found := worlds.differs(before, actions):
                    return found + _hint(run)
    return _scores(run, last) or _starts(run)


def _hint(run: CheckRun) -> str:
    """Name the hook that an arena with a game of its own may lack."""
    lacks = type(run.arena).exchange is Game.exchange and jax.tree.leaves(run.first.game)
    return "; if `game` keeps something by team, override `exchange()` to swap it" if lacks else ""


def _orders(arena: Arena) -> list[tuple[int, ...]]:
    """Return permutations of the teams of which all others that keep rosters are made."""
    found, every = [], range(len(arena.teams))
    for equal in exchangeable(arena):
        moves = [[equal[1], equal[0], *equal[2:]], *([[*equal[1:], equal[0]]] if len(equal) > 2 else [])]
        found += [tuple(dict(zip(equal, move, strict=True)).get(team, team) for team in every) for move in moves]
    return found


class _ExchangedWorlds:
    """The worlds of a check run with team i in the place of team `order[i]`."""

    def __init__(self, run: CheckRun, order: tuple[int, ...]):
        arena = run.arena
        names = [[agent.name for agent in team.agents] for team in arena.teams]
        self.other = {
            name: other for i, own in enumerate(names) for name, other in zip(own, names[order[i]], strict=True)
        }
        self.run, self.order = run, list(order)
        exchange = arena.exchange if len(order) == 2 else partial(arena.exchange, order=order)
        self._exchange = jax.jit(jax.vmap(exchange))
        self._see = jax.jit(
            jax.vmap(lambda state: (arena.alive(state.physics, state.game), _raw_observations(arena, state)))
        )

    def differs(self, before: State, actions: dict[str, Array]) -> str:
        """Describe how a decision of the exchanged worlds differs from the original; empty if it does not."""
        physics, game = before.physics, before.game
        ours, original = self._place(before, physics.qpos, physics.qvel, game, before.actions)
        qpos, qvel, exchanged = self._exchange(physics.qpos, physics.qvel, game)
        theirs, exchanged_back = self._place(before, qpos, qvel, exchanged, self._counterparts(before.actions))
        going = ~np.asarray(before.done)
        observations = {
            f"the observation of {name}": (exchanged_back[name], original[other]) for name, other in self.other.items()
        }
        if found := _difference(observations, going):
            return found
        ours, theirs = self.run.act(ours, actions), self.run.act(theirs, self._counterparts(actions))
        alike = self._moved_alike(ours, theirs) & ~np.asarray(ours.void | theirs.void)
        return self._verdicts(ours.verdict, theirs.verdict, going & alike)

    def _moved_alike(self, ours: State, theirs: State) -> np.ndarray:
        """Return (WORLDS,) bool: the bodies of both versions moved alike, so their verdicts can be compared.

        MuJoCo's C engine solves contacts in double precision, so its bodies always move alike. The engines of
        accelerators add in single precision, in the order of the robots, so two versions soon differ after a contact.
        """
        if self.run.arena.engine.name not in ("jax", "warp"):
            return np.ones(WORLDS, bool)
        qpos, qvel, _ = self._exchange(ours.physics.qpos, ours.physics.qvel, ours.game)
        pairs = (qpos, theirs.physics.qpos), (qvel, theirs.physics.qvel)
        return np.all([np.isclose(a, b, MOVED, MOVED).all(1) for a, b in pairs], 0)

    def _counterparts(self, actions: Mapping[str, Array]) -> dict[str, Array]:
        """Return for each agent the action of the one whose place it has."""
        return {name: actions[self.other[name]] for name in self.other}

    def _place(
        self, like: State, qpos: Array, qvel: Array, game: Any, actions: Mapping[str, Array]
    ) -> tuple[State, dict[str, Array]]:
        """Put the worlds into this situation at their current time, with the model's own fields; return them and
        observations.
        """
        arena, every = self.run.arena, jnp.ones(WORLDS, bool)
        plain = {
            name: jnp.broadcast_to(jnp.asarray(getattr(arena.scene.model, name), jnp.float32), own.shape)
            for name, own in like.physics.model.items()
            if name in VARIABLE
        }
        placed = self.run.place(like.physics, qpos, qvel, every, plain)._replace(time=like.physics.time)
        state = like._replace(physics=placed, game=game, actions=dict(actions))
        alive, original = self._see(state)
        return state._replace(alive=alive), original

    def _verdicts(self, ours: Verdict, theirs: Verdict, worlds: np.ndarray) -> str:
        """Describe a verdict in these `worlds` (WORLDS,) bool that a team got and the one in its place did not."""
        ends = [np.asarray(each.terminated | each.truncated) for each in (ours, theirs)]
        for name, one, other in (
            ("the end of the game", ours.terminated, theirs.terminated),
            ("the cut of the game", ours.truncated, theirs.truncated),
        ):
            if found := _difference({name: (other, one)}, worlds):
                return found
        terms = {
            f"{what} {name}": (other, np.asarray(one)[:, self.order])
            for what, mine, yours in (
                ("reward", ours.rewards, theirs.rewards), ("shaping", ours.shapings, theirs.shapings),
                ("event", ours.events, theirs.events),
            )
            for (name, one), other in zip(mine.items(), yours.values(), strict=True)
        }  # fmt: skip
        scores = {"the score": (theirs.score, np.asarray(ours.score)[:, self.order])}
        return _difference(terms, worlds) or _difference(scores, worlds & ends[0])


def _raw_observations(arena: Arena, state: State) -> dict[str, Array]:
    return arena.observe(state.physics, state.game, state.actions)


def _difference(pairs: Mapping[str, tuple[Any, Any]], worlds: np.ndarray) -> str:
    """Describe the difference between pairs of arrays (WORLDS, ...) in these worlds."""
    found = difference(
        {name: np.asarray(one)[worlds] for name, (one, _) in pairs.items()},
        {name: np.asarray(other)[worlds] for name, (_, other) in pairs.items()},
        CLOSE,
    )
    return f"{found} when the teams change places" if found else ""


# Scores --------------------------------------------------------------------------------------------------------------


def _scores(run: CheckRun, last: State) -> str:
    """Describe a side on which one policy scores better than on the other, in ended worlds; empty if there is none."""
    points: dict[tuple[int, int], list[float]] = {
        (equal[0], other): [] for equal in exchangeable(run.arena) for other in equal[1:]
    }
    chances: dict[tuple[int, int], float] = {}
    for number in range(1, EPISODES + 1):
        ended = np.asarray(last.done & ~last.void)
        score = np.asarray(last.verdict.score)[ended]
        for (one, other), own in points.items():
            own += (0.5 * np.sign(score[:, one] - score[:, other])).tolist()
        chances = {pair: sign_test(own) for pair, own in points.items()}
        one_sided = any(len({point > 0 for point in own if point}) == 1 for own in points.values())
        if min(chances.values()) > P_PLAY_ON and not one_sided:
            return ""
        if min(chances.values()) < P_UNEQUAL:
            break
        if number < EPISODES:
            last = _last(_play(run, number))
    pair = min(chances, key=chances.__getitem__)
    if chances[pair] >= P_UNEQUAL:
        return ""
    one, other = (run.arena.teams[team].name for team in pair)
    mean, games = np.mean(points[pair]) + 0.5, len(points[pair])
    return f"one policy in all teams scores {mean:.0%} as {one} against {other} in {games} games: the sides are unequal"


def sign_test(points: list[float]) -> float:
    """Return the two-sided p-value of a sign test that scores lean to neither side; draws are left out."""
    won, lost = (sum(sign * point > 0 for point in points) for sign in (1, -1))
    decided, least = won + lost, min(won, lost)
    tail = sum(math.comb(decided, k) for k in range(least + 1)) / 2**decided
    return min(1.0, 2.0 * tail)


# Starts --------------------------------------------------------------------------------------------------------------


def _starts(run: CheckRun) -> str:
    """Describe a number that exchanged agents first observe unequally, on average; empty if there is none."""
    keys = [jax.random.split(jax.random.fold_in(run.key, 2000 + i), WORLDS) for i in range(STARTS)]
    seen = [jax.device_get(run.reset(own).observations) for own in keys]
    teams = run.arena.teams
    for one, other in ((teams[each[0]], teams[i]) for each in exchangeable(run.arena) for i in each[1:]):
        for ours, theirs in zip(one.agents, other.agents, strict=True):
            a, b = (np.concatenate([own[agent.name] for own in seen]).astype(float) for agent in (ours, theirs))
            # Sizes too: a nearer start in a random direction has the same mean.
            for what, mine, yours in (("mean", a, b), ("mean size", np.abs(a), np.abs(b))):
                leans = np.flatnonzero(_leans(mine, yours))
                if leans.size:
                    i = int(leans[0])
                    return (
                        f"at the start {_number(run.arena, ours.name, i)} has {what} {mine[:, i].mean():.3g} for "
                        f"{ours.name} and {yours[:, i].mean():.3g} for {theirs.name}: draw the sides in `place`, "
                        "or leave out `exchangeable`"
                    )
    return ""


def _leans(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Return for each number whether it is unequal; in a fair arena differences within worlds are symmetric about 0."""
    gaps = ours - theirs
    spread = np.sqrt((gaps**2).sum(0))
    large = np.abs(gaps.mean(0)) > CLOSE * (1.0 + np.abs(ours).mean(0))
    return large & (np.abs(gaps.sum(0)) > LEAN * spread)


def _number(arena: Arena, agent: str, index: int) -> str:
    """Name a number of an observation, by its part if the arena names parts."""
    first = 0
    for part in arena.observation_parts(agent):
        if index < first + part.size:
            return f"number {index - first} of `{part.name}`"
        first += part.size
    return f"number {index} of the observation"


# Play ----------------------------------------------------------------------------------------------------------------


def _play(run: CheckRun, number: int) -> Iterator[Step]:
    """Play an episode in every world, with one policy for all teams of a world."""
    arena, key = run.arena, jax.random.fold_in(run.key, 1000 + number)
    decide = _policy(arena)
    state = run.first if number == 0 else run.reset(jax.random.split(key, WORLDS))
    for decision in range(arena.timing.decisions):
        actions = decide(state.observations, jax.random.fold_in(key, decision))
        after = run.act(state, actions)
        yield Step(state, actions, after)
        state = after
        if bool(state.done.all()):
            return


def _last(steps: Iterator[Step]) -> State:
    *_, step = steps
    return step.after


def _policy(arena: Arena) -> Any:
    """Compile actions (WORLDS, act) of all agents: random in one world, by the first script in the next, and so on."""
    scripts, playable = arena.scripts(), [arena.playable_scripts(team) for team in arena.teams]
    names = [name for name in playable[0] if all(name in others for others in playable)]
    turn = jnp.arange(WORLDS) % (1 + len(names))

    def decide(observations: dict[str, Array], key: Array) -> dict[str, Array]:
        found = {}
        for agent, own in zip(arena.agents, jax.random.split(key, len(arena.agents)), strict=True):
            keys = jax.random.split(own, WORLDS)
            choices = [jax.random.uniform(own, (WORLDS, agent.action_size), minval=-1.0)]
            choices += [jax.vmap(scripts[name][agent.kind])(observations[agent.name], keys) for name in names]
            found[agent.name] = jnp.stack(choices)[turn, jnp.arange(WORLDS)]
        return found

    return jax.jit(decide)
