"""What each variant of the learner keeps in its checkpoint, and goes on from."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.settings import Architecture
from storage.blobs import arrays
from tests.agents.paper import worst_gap
from tests.agents.trios import FULL, PLAIN, new_learner

VARIANTS = {
    "mappo": {"method": "mappo"},
    "ippo": {"method": "ippo"},
    "hatrpo": {"method": "hatrpo"},
    "target_kl": {"target_kl": 0.02},
    "desired_kl": {"desired_kl": 0.01},
    "decay": {"lr_decay_steps": 200},
    "magnet": {"magnet_coef": 0.1, "magnet_updates": 2},
    "magnet, shared": {"magnet_coef": 0.1, "share_actors": True, "architecture": Architecture((5,), squash=1.0)},
    "shared": {"share_actors": True},
    "shared ippo": {"share_actors": True, "method": "ippo"},
    "shared hatrpo": {"share_actors": True, "method": "hatrpo"},
    "squashed": {"architecture": Architecture((5,), squash=1.5)},
    "state_std": {"architecture": Architecture((5,), state_std=True)},
    "both": {"architecture": Architecture((5,), squash=1.0, state_std=True), "method": "hatrpo"},
    "recurrent": {"architecture": Architecture((5,), recurrent=4), "chunk_length": 4},
    "recurrent, shared": {
        "architecture": Architecture((5,), recurrent=4, squash=1.0, layer_norm=True),
        "chunk_length": 2,
        "share_actors": True,
    },
    "recurrent ippo": {
        "architecture": Architecture((5,), recurrent=4, state_std=True),
        "chunk_length": 8,
        "method": "ippo",
    },
    "recurrent hatrpo": {"architecture": Architecture((5,), recurrent=4), "chunk_length": 4, "method": "hatrpo"},
}


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_every_variant_goes_on_from_its_checkpoint_as_if_nothing_had_been(variant, experience, same):
    config = replace(FULL, **variant)
    learner = new_learner(config)
    for seed in range(2):
        learner.learn(experience(learner, seed=seed, void=0.1))
    saved = arrays.to_bytes(learner.save())
    then = experience(learner, seed=9)
    figures = learner.learn(then)
    resumed = new_learner(config, seed=77)
    resumed.load(arrays.from_bytes(saved))
    assert same(resumed.save(), arrays.from_bytes(saved))
    assert resumed.learn(then) == figures
    assert same(resumed.save(), learner.save())
    assert all(np.isfinite(x).all() for x in learner.save().values())


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_who_is_out_all_the_time_changes_nothing_but_its_own_critic(variant, experience):
    learner = new_learner(replace(PLAIN, **variant))
    batch = experience(learner, seed=3, void=0.1)
    before = [copy.deepcopy(actor) for actor in learner.actors]
    figures = learner.learn(batch._replace(alive=[*batch.alive[:2], torch.zeros_like(batch.alive[2])]))
    assert np.isfinite(list(figures.values())).all()
    assert worst_gap(before[0], learner.actors[0]) > 0.0
    assert worst_gap(before[2], learner.actors[2]) == 0.0


def test_settings_that_are_off_leave_no_trace_in_a_checkpoint():
    keys = set(new_learner(PLAIN).save())
    assert {k.split(".")[0] for k in keys} == {"actor", "adam", "critic", "rng", "value_norm"}
    for name, added in {
        "decay": {"steps"},
        "shared": {"sharing"},
        "desired_kl": {f"adam.actor.{i}.lr" for i in range(3)},
    }.items():
        assert set(new_learner(replace(PLAIN, **VARIANTS[name])).save()) - keys == added


@pytest.mark.parametrize(
    ("saved", "named"),
    [
        ("squashed", r"does not fit this learner: actor\.0\.squash, actor\.1\.squash, actor\.2\.squash \(3 in all\)"),
        ("state_std", r"does not fit this learner: actor\.0\.std_logit"),
        ("shared", r"does not fit this learner: actor\.1\."),
        ("ippo", r"does not fit this learner: critic\.trunk\."),
        ("hatrpo", r"does not fit this learner: adam\.actor\.0"),
        ("recurrent", r"does not fit this learner: actor\.0\.mean\.weight"),
    ],
)
def test_a_checkpoint_of_another_variant_is_refused(saved, named, same):
    learner = new_learner(PLAIN)
    before = learner.save()
    with pytest.raises(ValueError, match=named):
        learner.load(new_learner(replace(PLAIN, **VARIANTS[saved])).save())
    assert same(learner.save(), before)


def test_another_limit_is_another_policy():
    small, large = (new_learner(replace(PLAIN, architecture=Architecture((5,), squash=s))) for s in (1.0, 2.0))
    with pytest.raises(ValueError, match=r"actor\.0\.squash"):
        small.load(large.save())


def test_a_checkpoint_of_before_each_number_was_counted_is_read(experience, same):
    learner, later = new_learner(FULL, seed=1), new_learner(FULL, seed=2)
    learner.learn(experience(learner, seed=4))
    state = learner.save()
    counts = [state.pop(f"{name}.observed")[0] for name in ("actor.0", "actor.1", "actor.2", "critic")]
    later.load({**state, "observation_counts": np.array(counts, np.float32)})
    same(later.save(), learner.save())
    later.warm_start([({**state, "observation_counts": np.array([1, 2, 3, 4], np.float32)}, 1), None, None], None)
    assert [set(n.tolist()) for n in later.observed] == [{2}, {48}, {48}, {48}]


def test_shared_and_single_actors_go_on_from_each_other(experience):
    shared, single = (new_learner(replace(FULL, share_actors=s), seed=1 + s) for s in (True, False))
    for learner in (shared, single):
        learner.learn(experience(learner, seed=4))
    theirs = single.save()
    split = new_learner(FULL, seed=9)
    split.warm_start([(shared.save(), 1), (shared.save(), 0), (shared.save(), 2)], None)
    assert worst_gap(split.actors[0], shared.actors[0]) == worst_gap(split.actors[1], shared.actors[0]) == 0.0
    assert worst_gap(split.actors[2], shared.actors[2]) == 0.0
    assert [set(n.tolist()) for n in split.observed] == [{96}, {96}, {48}, {0}]
    joined = new_learner(replace(FULL, share_actors=True), seed=9)
    joined.warm_start([(theirs, 1), (theirs, 0), (theirs, 2)], theirs)
    assert worst_gap(joined.actors[0], single.actors[1]) == worst_gap(joined.actors[2], single.actors[2]) == 0.0
    assert [set(n.tolist()) for n in joined.observed] == [{48}, {48}, {48}]
