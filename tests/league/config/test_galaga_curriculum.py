"""The curricula of 3D Galaga: who aims in a match has aimed alone, who flies has flown alone."""

import pytest

from league.config import experiment as configuration
from league.config import presets
from league.snapshots import warm_start
from league.snapshots.warm_start import Source, WarmStart
from storage.records import Player


def players(config):
    """A player for each team of a stage's arena, by the settings alone."""
    teams = config.arena.outline().teams
    return [
        Player(
            config.league,
            team,
            number,
            "main",
            "+".join(f"{seat.kind}:{seat.observation_size}:{seat.action_size}" for seat in seats),
        )
        for number, (team, seats) in enumerate(teams.items())
    ]


@pytest.mark.parametrize(("size", "critics"), [("1v1", True), ("1v1-sight", True), ("2v2", False)])
def test_tanks_and_drones_go_on_in_the_match_from_where_they_were_alone(size, critics):
    config = presets.preset(f"galaga-{size}")
    assert configuration.loads(configuration.dumps(config)) == config
    aim, fly, match = (players(configuration.stage(config, number)) for number in range(3))
    found = warm_start.warm_starts(match, [fly, aim])
    count, league = int(size[0]), f"galaga-{size[:3]}"
    for team, stage in (("blue", "aim"), ("red", "fly")):
        source = Source(f"{league}.{stage}", team, 0)
        assert found[team] == WarmStart((source,) * count, (f"{league}.{stage}", team) if critics else None)


def test_where_both_see_each_other_the_tank_is_as_slow_alone_as_in_the_match_and_the_drone_learns_first():
    config = presets.preset("galaga-1v1-sight")
    aim, fly, match = (configuration.stage(config, number) for number in range(3))
    assert (
        aim.arena.rules.tank_speed == match.arena.rules.tank_speed < presets.preset("galaga-1v1").arena.rules.tank_speed
    )
    seen = match.arena.outline().teams
    assert [aim.arena.outline().teams["blue"], fly.arena.outline().teams["red"]] == [seen["blue"], seen["red"]]
    assert (aim.arena.buffer, match.arena.rich) == (8, True)
    schedule = match.training.schedule
    assert (schedule.kind, schedule.learner, schedule.until_score) == ("leapfrog", 1, 0.7)
    assert (match.learner.lr, match.learner.gamma, match.training.shaping_steps) == (3e-4, 0.995, 0)
