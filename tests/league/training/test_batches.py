"""A player's part of what was collected, as its settings and its arena's choose it."""

from dataclasses import replace

import jax.numpy as jnp
import pytest

import arenas
from agents.rollout.rollout import Trajectory
from league.config import experiment as configuration
from league.training.learner_factory import batch_of, void_penalty
from storage.records import Player


def broken(arena) -> Trajectory:
    """One decision in one world, which team 0 makes void."""
    no, of_teams = jnp.zeros((1, 1), bool), jnp.zeros((1, 1, len(arena.teams)))
    seen = {a.name: jnp.zeros((1, 1, a.observation_size)) for a in arena.agents}
    acted = {a.name: jnp.zeros((1, 1, a.action_size)) for a in arena.agents}
    one = {a.name: jnp.ones((1, 1)) for a in arena.agents}
    alive = {name: ~no for name in one}
    at_fault = of_teams.astype(bool).at[..., 0].set(True)
    return Trajectory(
        seen, seen, acted, one, alive, alive, of_teams, of_teams, of_teams, no, no, ~no, at_fault, no,
        jnp.ones((1, 1), jnp.int32),
    )  # fmt: skip


def test_who_breaks_physics_pays_what_a_loss_costs(duel):
    settings = arenas.settings("sumo-1v1")
    config = replace(configuration.default(), arena=replace(settings, reward=replace(settings.reward, scale=10.0)))
    paid = [
        batch_of(config, duel, Player("cup", team.name, number, "main", team.roster, "main"), broken(duel))
        for number, team in enumerate(duel.teams)
    ]
    assert [(batch.rewards.item(), batch.terminated.item()) for batch in paid] == [(-10.0, True), (0.0, False)]
    assert paid[1].void.item()


@pytest.mark.parametrize(
    ("name", "cost"), [("soccer-1v1", 20), ("sumo-by-team", 10), ("anymal-walk", 2), ("sumo-2v2", 1), ("kuhn-poker", 1)]
)
def test_the_worst_end_of_an_episode_is_that_of_the_arenas_settings(name, cost):
    assert void_penalty(configuration.default(name)) == cost


@pytest.mark.parametrize("name", arenas.known())
def test_every_arena_has_the_weights_that_it_names_for_the_worst_end(name):
    assert void_penalty(configuration.default(name)) >= 1
