"""The curricula of 3D Galaga: who aims in a match has aimed alone, who flies has flown alone."""

import pytest

from league.config import experiment as configuration
from league.config import presets
from league.snapshots.transfer import warm_start
from league.snapshots.transfer.warm_start import Source, WarmStart
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


@pytest.mark.parametrize(("size", "critics"), [("1v1", True), ("2v2", False)])
def test_tanks_and_drones_go_on_in_the_match_from_where_they_were_alone(size, critics):
    config = presets.preset(f"galaga-{size}")
    assert configuration.loads(configuration.dumps(config)) == config
    aim, fly, match = (players(configuration.stage(config, number)) for number in range(3))
    found = warm_start.warm_starts(match, [fly, aim])
    count, league = int(size[0]), f"galaga-{size}"
    for team, stage in (("blue", "aim"), ("red", "fly")):
        source = Source(f"{league}.{stage}", team, 0)
        assert found[team] == WarmStart((source,) * count, (f"{league}.{stage}", team) if critics else None)
