"""Turns of a small league in one process, as one worker does them."""

from dataclasses import replace

from league.config import experiment as configuration
from league.config import presets
from league.scheduling import turn_scheduler
from league.state.jobs import decode
from league.state.league_state import LeagueState
from league.training.trainer import Trainer
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.records import League, Player
from storage.store import Store

LEAGUE = "duel"


def settings(schedule=Schedule(), opponents=Opponents(), **changes):  # noqa: B008  (frozen)
    """A duel of 16 worlds with turns of four iterations of 8 decisions, that runs until a test has seen enough."""
    config = presets.preset("duel")
    size = {"worlds": 16, "rollout_length": 8, "iterations_per_turn": 4}
    training = replace(config.training, schedule=schedule, opponents=opponents, **size, **changes)
    return replace(config, deterministic=True, training=training, budget=configuration.Budget(steps=10**9))


def new_store(place, arena, config=None):
    """A store with the league, or that of a configuration, and a main player in each of the arena's teams."""
    league, text = (LEAGUE, "") if config is None else (config.league, configuration.dumps(config))
    store = Store.open(place, create=True)
    store.create_league(League(league, text))
    store.add_players([Player(league, t.name, i, "main", t.roster) for i, t in enumerate(arena.teams)])
    return store


def claim(store, config):
    """What is planned is queued, and the next turn taken: its lease and what it says."""
    planned = turn_scheduler.next_turns(config, LeagueState.of(store, LEAGUE))
    store.queue(planned.jobs, planned.phases)
    claimed = store.claim(LEAGUE, ["train"], "me", 60)
    assert claimed is not None
    lease, job = claimed
    return lease, decode(job)


def new_trainer(config, arena, store, worlds=None):
    """One process's trainer, with what an earlier one has compiled of that arena for such settings: it takes seconds.

    No program depends on what its trainer has learnt.
    """
    (league,) = store.leagues()
    programs = next((each for each in _PROGRAMS if each.fit(config, arena)), None)
    made = Trainer(config, arena, store.players(league.name), worlds or config.training.worlds, programs=programs)
    if programs is None:
        _PROGRAMS.append(made.programs)
    return made


_PROGRAMS = []


def turns(store, config, arena, count, trainer=None):
    """Let one worker, which is new or has this trainer, do the next turns as planned; the trainer afterwards."""
    trainer = trainer or new_trainer(config, arena, store)
    for _ in range(count):
        lease, turn = claim(store, config)
        for _ in trainer.turn(store, turn, lambda: False):
            pass
        trainer.commit(store, lease, turn)
    return trainer


def history(store):
    """Whose checkpoints were written, at which iteration and with which bytes, in their order."""
    return [(c.player, c.iteration, c.digest) for c in store.checkpoints(LEAGUE)]


def ends(store):
    """How far each player is, and the digest of its newest checkpoint."""
    return {name: (c.iteration, c.digest) for name, c in store.newest_checkpoints(LEAGUE).items()}
