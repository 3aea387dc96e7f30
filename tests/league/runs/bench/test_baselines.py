"""Settings of the bench's baselines: what methods differ in."""

import pytest

from experiments import baselines
from league.runs.bench import tasks


@pytest.mark.parametrize(
    ("method", "learner", "shared"), [("latest", "happo", False), ("shared", "happo", True), ("mappo", "mappo", True)]
)
def test_rovers_share_an_actor_by_two_methods_alone(method, learner, shared):
    args = baselines.parsed(["--tasks", "t1-sumo-rovers-v1", "--steps", "1000"])
    config = baselines.config_of(tasks.find("t1-sumo-rovers-v1"), method, 1, args)
    assert (config.learner.method, config.learner.share_actors) == (learner, shared)
    assert config.training.opponents.kind == "latest"
