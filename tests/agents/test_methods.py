"""What each variant of the learner computes, against formulas written here a second time, and what it keeps."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.batch import Batch, clean
from agents.errors import Diverged
from agents.happo import Learner
from agents.settings import Architecture, HappoConfig
from league.config.build import build
from league.config.experiment import Config
from league.config.schema import ConfigError
from storage import arrays
from tests.agents.variants import with_sides

PLAIN = HappoConfig(
    Architecture((5,)), lr=0.02, critic_lr=0.05, gamma=0.0, epochs=2, minibatches=1, max_grad_norm=0.5,
    fixed_order=True, value_norm=False,
)  # fmt: skip
FULL = replace(PLAIN, gamma=0.97, minibatches=3, value_norm=True, normalise_observations=True, fixed_order=False)
EQUAL = {"observation_sizes": [4, 4, 3], "action_sizes": [2, 2, 1]}  # two equal robots and another


def new_learner(config: HappoConfig, seed: int = 0, **where) -> Learner:
    return Learner(**EQUAL, config=config, seed=seed, **where)


def gap(a: torch.nn.Module, b: torch.nn.Module) -> float:
    return max(float((x - y).detach().abs().max()) for x, y in zip(a.parameters(), b.parameters(), strict=True))


def standardised(A: Tensor) -> Tensor:
    return (A - A.mean()) / (A.std(correction=0) + 1e-5)


def ppo(actor: torch.nn.Module, share: tuple[Tensor, ...], A: Tensor, c: HappoConfig) -> None:
    """PPO on the whole batch with an Adam of its own."""
    obs, actions, old = share
    optimizer = torch.optim.Adam(actor.parameters(), c.lr, eps=1e-5)
    for _ in range(c.epochs):
        policy = actor(obs)
        r = (policy.log_prob(actions).sum(-1) - old).exp()
        gain = torch.minimum(r * A, torch.clamp(r, 1 - c.clip, 1 + c.clip) * A).mean()
        optimizer.zero_grad()
        (-gain - c.entropy * policy.entropy().sum(-1).mean()).backward()
        torch.nn.utils.clip_grad_norm_(actor.parameters(), c.max_grad_norm)
        optimizer.step()


def lived(batch: Batch, i: int) -> tuple[Tensor, Tensor, Tensor]:
    return batch.observations[i].flatten(0, 1), batch.actions[i].flatten(0, 1), batch.log_probs[i].flatten(0, 1)


def density(actor: torch.nn.Module, share: tuple[Tensor, ...]) -> Tensor:
    with torch.no_grad():
        return actor(share[0]).log_prob(share[1]).sum(-1)


# Methods --------------------------------------------------------------------------------------------------------------


def test_in_mappo_every_agent_learns_from_the_same_advantage(experience):
    learner = new_learner(replace(PLAIN, method="mappo"))
    batch = experience(learner, seed=2)
    expected = [copy.deepcopy(a) for a in learner.actors]
    with torch.no_grad():
        A = (batch.rewards - learner.critic_learners[0].network(torch.cat(list(batch.observations), -1))).flatten()
    for i, actor in enumerate(expected):
        ppo(actor, lived(batch, i), standardised(A), PLAIN)
    learner.update(batch)
    assert max(map(gap, expected, learner.actors)) < 1e-6

    happo = new_learner(PLAIN)
    happo.update(batch)
    assert gap(happo.actors[0], learner.actors[0]) == 0.0  # M is 1 for the first
    assert gap(happo.actors[1], learner.actors[1]) > 1e-4


def test_in_ippo_every_agent_has_its_own_critic_and_its_own_advantage(experience):
    learner = new_learner(replace(PLAIN, method="ippo"))
    batch = experience(learner, seed=2)
    out = torch.zeros_like(batch.alive[1])
    out[:3] = True
    batch = batch._replace(alive=[batch.alive[0], ~out, batch.alive[2]])
    expected = [copy.deepcopy(a) for a in learner.actors]
    critics = [copy.deepcopy(c.network) for c in learner.critic_learners]
    for i, (actor, critic) in enumerate(zip(expected, critics, strict=True)):
        here = batch.alive[i].flatten()
        with torch.no_grad():
            A = (batch.rewards - critic(batch.observations[i])).flatten()[here]
        ppo(actor, tuple(x[here] for x in lived(batch, i)), standardised(A), PLAIN)
    learner.update(batch)
    assert max(map(gap, expected, learner.actors)) < 1e-6
    assert [len(c.network.trunk.observation_mean) for c in learner.critic_learners] == [4, 4, 3]
    assert min(gap(old, new.network) for old, new in zip(critics, learner.critic_learners, strict=True)) > 1e-3


@pytest.mark.parametrize("method", ["happo", "mappo", "ippo"])
def test_alone_every_method_is_ppo(method, experience, same):
    one = {"observation_sizes": [4], "action_sizes": [2], "seed": 5}
    ours, plain = (Learner(**one, config=replace(FULL, method=m)) for m in (method, "happo"))
    for seed in range(2):
        batch = experience(plain, seed=seed, void=0.1)
        assert ours.update(batch) == plain.update(batch)
    assert same(ours.state(), plain.state())


# What bounds a step ---------------------------------------------------------------------------------------------------


def test_passes_end_when_the_policy_has_moved_far_enough(experience):
    wild = replace(PLAIN, lr=0.05, epochs=6)
    counts = {}
    for stop in (None, 1e-9, 0.05, 1e9):
        learner = new_learner(replace(wild, kl_stop=stop))
        batch = experience(learner, seed=3)
        learner.update(batch)
        counts[stop] = int(learner.state()["adam.actor.0.mean.bias.step"])
        assert learner.state()["adam.critic.value.bias.step"] == 6
    assert counts[None] == counts[1e9] == 6
    assert counts[1e-9] == 1
    assert counts[0.05] == 3


@pytest.mark.parametrize(("target", "factor"), [(1e-6, 1 / 1.5), (1e3, 1.5), (0.04, 1.0)])
def test_the_step_size_follows_the_divergence(target, factor, experience):
    """A batch stale by up to 30 % has a divergence of 0.015: half and twice of the last target lie around it."""
    config = replace(PLAIN, lr=2e-3, epochs=1)
    learner = new_learner(replace(config, kl_step=target if target != 0.04 else 0.015))
    same_steps = new_learner(replace(config, lr=2e-3 * factor))
    batch = experience(learner, seed=3)
    figures = learner.update(batch)
    same_steps.update(batch)
    assert figures["lr"] == pytest.approx(2e-3 * factor, rel=1e-5)
    assert 0.0075 < figures["kl"] < 0.03
    assert max(map(gap, learner.actors, same_steps.actors)) < 1e-7


def test_the_adaptive_step_size_stays_within_bounds(experience):
    for target, bound in ((1e-9, 1e-5), (1e9, 1e-2)):
        learner = new_learner(replace(PLAIN, lr=1e-3, kl_step=target, epochs=30))
        learner.update(experience(learner, seed=3))
        assert [a.lr.item() for a in learner.actor_learners] == [bound] * 3


def test_step_sizes_fall_to_nothing_over_the_steps_learnt_from(experience, same):
    learner = new_learner(replace(FULL, decay_steps=4 * 48))
    batches = [experience(learner, seed=s) for s in range(6)]
    told = [learner.update(batch)["lr"] for batch in batches[:4]]
    assert told == pytest.approx([0.02, 0.015, 0.01, 0.005])
    before = learner.state()
    assert learner.update(batches[4])["lr"] == 0.0
    weights = [k for k in before if k.startswith(("actor.", "critic.")) and "observation_" not in k]
    assert same([before[k] for k in weights], [learner.state()[k] for k in weights])

    half = new_learner(replace(FULL, decay_steps=2 * 48))
    constant = new_learner(replace(FULL, lr=0.01, critic_lr=0.025))
    half.steps += 48
    half.update(batches[5])
    constant.update(batches[5])
    mine, theirs = half.state(), constant.state()
    assert same({k: mine[k] for k in theirs}, theirs)


# Precision ------------------------------------------------------------------------------------------------------------


def test_half_the_digits_learn_nearly_the_same(experience):
    full, half = (new_learner(replace(FULL, precision=p)) for p in ("float32", "bf16"))
    fresh = new_learner(FULL)
    for seed in range(2):
        batch = experience(full, seed=seed, void=0.1)
        told = [each.update(batch) for each in (full, half)]
    assert told[1] == pytest.approx(told[0], rel=0.15, abs=0.05)
    for ours, exact, start in zip(half.actors, full.actors, fresh.actors, strict=True):
        assert 0 < gap(ours, exact) < 0.3 * gap(start, exact)
    assert {array.dtype for name, array in half.state().items() if ".weight" in name} == {np.dtype(np.float32)}


def test_tf32_is_for_the_update_alone(experience, same, monkeypatch):
    matmul, seen = torch.backends.cuda.matmul, []
    before = matmul.fp32_precision
    exact, coarse = (new_learner(replace(FULL, precision=p)) for p in ("float32", "tf32"))
    batch = experience(exact, seed=1)
    for learner in (exact, coarse):
        learn = learner.critic_learners[0].learn
        monkeypatch.setattr(
            learner.critic_learners[0], "learn", lambda *x, learn=learn: (seen.append(matmul.fp32_precision), learn(*x))
        )
        learner.update(batch)
        assert matmul.fp32_precision == before
    assert seen == [before] * FULL.epochs + ["tf32"] * FULL.epochs
    assert same(exact.state(), coarse.state())  # a CPU knows no such thing
    batch.rewards.fill_(float("nan"))
    with pytest.raises(Diverged):
        coarse.update(batch)
    assert matmul.fp32_precision == before


# Who shares what ------------------------------------------------------------------------------------------------------


def test_equal_robots_share_an_actor_and_learn_it_from_all_that_they_did(experience):
    learner = new_learner(replace(PLAIN, share_actors=True))
    batch = experience(learner, seed=2)
    assert learner.actors[0] is learner.actors[1]
    pair, single = copy.deepcopy(learner.actors[0]), copy.deepcopy(learner.actors[2])
    with torch.no_grad():
        A = (batch.rewards - learner.critic_learners[0].network(torch.cat(list(batch.observations), -1))).flatten()
    A = standardised(A)
    both = tuple(torch.cat(x) for x in zip(lived(batch, 0), lived(batch, 1), strict=True))
    before = density(pair, both)
    ppo(pair, both, torch.cat([A, A]), PLAIN)
    first, second = (density(pair, both) - before).exp().chunk(2)
    ppo(single, lived(batch, 2), first * second * A, PLAIN)  # M is the product of both agents' ratios
    learner.update(batch)
    assert gap(pair, learner.actors[0]) < 1e-6
    assert gap(single, learner.actors[2]) < 1e-6
    policies = learner.policies()
    assert len(policies) == 3
    assert all(torch.equal(policies[0][k], policies[1][k]) for k in policies[0])


def test_who_is_equal_is_told_by_kind_and_sizes():
    config = replace(PLAIN, share_actors=True)
    assert new_learner(config).leaders == [0, 0, 2]
    assert new_learner(config, kinds=["ant", "rover", "rover"]).leaders == [0, 1, 2]
    assert new_learner(PLAIN).leaders == [0, 1, 2]


def test_shared_statistics_are_those_of_all_that_share(experience):
    learner = new_learner(replace(FULL, share_actors=True))
    batch = experience(learner, seed=5)
    learner.update(batch)
    seen = torch.cat([batch.observations[0], batch.observations[1]]).flatten(0, 1)
    torch.testing.assert_close(learner.actors[1].trunk.observation_mean, seen.mean(0), atol=1e-5, rtol=1e-5)
    assert learner.observation_counts.tolist() == [96, 48, 48]


# What the critic sees -------------------------------------------------------------------------------------------------


def with_others(batch: Batch, seed: int = 11) -> Batch:
    rng = torch.Generator().manual_seed(seed)
    shape = batch.rewards.shape
    seen = [[torch.randn((*shape, n), generator=rng) for n in (3, 2)] for _ in range(2)]
    alive = [[torch.rand(shape, generator=rng) < 0.7 for _ in range(2)] for _ in range(2)]
    return batch._replace(others=seen[0], next_others=seen[1], others_alive=alive[0], next_others_alive=alive[1])


def test_a_critic_may_see_the_other_teams(experience, same):
    config = replace(FULL, critic_input="all", method="mappo")
    states = []
    for garbage in (None, float("nan")):
        learner = new_learner(config, others=[3, 2])
        batch = with_others(experience(learner, seed=4, void=0.1))
        if garbage is not None:  # who is out of the game shows zeros, whatever its numbers say
            for seen, alive in zip(batch.others, batch.others_alive, strict=True):
                seen[~alive] = garbage
        network = copy.deepcopy(learner.critic_learners[0].network)
        figures = learner.update(batch)
        states.append(learner.state())
    assert same(*states)
    assert len(network.trunk.observation_mean) == 4 + 4 + 3 + 3 + 2

    seen = [
        *batch.observations,
        *(o.where(a[..., None], 0.0) for o, a in zip(batch.others, batch.others_alive, strict=True)),
    ]
    critique = new_learner(config, others=[3, 2]).critic_learners[0].criticise(clean(batch))
    with torch.no_grad():
        sound = ~batch.void.flatten()
        torch.testing.assert_close(critique.predictions[sound], network(torch.cat(seen, -1))[~batch.void])
    assert np.isfinite(list(figures.values())).all()


@pytest.mark.parametrize(("critic_input", "sides"), [("privileged", 1), ("same", 3)])
def test_a_critic_that_sees_something_else_learns_from_that_alone(critic_input, sides, experience, same):
    config = replace(FULL, critic_input=critic_input)
    states = []
    for garbage in (None, float("nan")):
        learner = new_learner(config, sight=7)
        batch = with_sides(experience(learner, seed=4, void=0.1), sides)
        if garbage is not None:  # what is void means nothing, whatever its numbers say
            for side in batch.sides:
                for x in (side.seen, side.next_seen, side.rewards):
                    x[side.void] = garbage
        network = copy.deepcopy(learner.critic_learners[0].network)
        critique = learner.critic_learners[0].criticise(clean(batch))
        figures = learner.update(batch)
        states.append(learner.state())
    assert same(*states)
    assert np.isfinite(list(figures.values())).all()
    seen = torch.cat([side.seen.flatten(0, 1) for side in batch.sides])
    valid = ~torch.cat([side.void.flatten() for side in batch.sides])
    assert torch.equal(critique.valid, valid)
    with torch.no_grad():
        torch.testing.assert_close(critique.predictions[valid], network(seen[valid]))
    own = batch.rewards.numel()
    assert critique.advantages.shape == (own,)
    torch.testing.assert_close(critique.returns[:own], critique.advantages + critique.values[:own])
    assert learner.observation_counts[-1] == valid.sum()
    np.testing.assert_allclose(states[0]["critic.trunk.observation_mean"], seen[valid].mean(0), atol=1e-5)


def test_a_critic_common_to_all_teams_learns_as_one_to_whom_all_of_them_were_worlds_of_one_team(experience):
    config = replace(PLAIN, gamma=0.97, critic_input="same", value_norm=True)
    common = new_learner(config, sight=7)
    batch = with_sides(experience(common, seed=4, void=0.1), 3)
    one = Learner([7], [2], replace(config, critic_input="own"), seed=3)
    one.critic_learners[0].network.load_state_dict(common.critic_learners[0].network.state_dict())
    fields = [torch.cat(each, 1) for each in zip(*batch.sides, strict=True)]
    wide = experience(one, seed=5, N=3 * batch.rewards.shape[1])
    wide = wide._replace(
        observations=[fields[0]], next_observations=[fields[1]], rewards=fields[2], terminated=fields[3],
        void=fields[4], truncated=torch.cat([batch.truncated] * 3, 1),
    )  # fmt: skip
    before = copy.deepcopy(common.critic_learners[0].network)
    told, alike = common.critic_learners[0].criticise(clean(batch)), one.critic_learners[0].criticise(clean(wide))
    T, N = batch.rewards.shape
    torch.testing.assert_close(told.advantages.view(T, N), alike.advantages.view(T, 3 * N)[:, :N])
    figures = common.update_critic_only(batch)
    assert figures == pytest.approx(one.update_critic_only(wide), abs=1e-5)
    assert gap(common.critic_learners[0].network, one.critic_learners[0].network) < 1e-6
    assert gap(before, one.critic_learners[0].network) > 1e-3


@pytest.mark.parametrize(("critic_input", "sides"), [("privileged", 1), ("same", 2)])
def test_such_a_critic_goes_on_from_its_checkpoint_as_if_nothing_had_been(critic_input, sides, experience, same):
    config = replace(FULL, critic_input=critic_input)
    learner = new_learner(config, sight=7)
    learner.update(with_sides(experience(learner, seed=1, void=0.1), sides))
    saved = arrays.to_bytes(learner.state())
    assert {k.split(".")[0] for k in learner.state()} == {k.split(".")[0] for k in new_learner(FULL).state()}
    then = with_sides(experience(learner, seed=9), sides, seed=5)
    figures = learner.update(then)
    resumed = new_learner(config, seed=77, sight=7)
    resumed.load(arrays.from_bytes(saved))
    assert resumed.update(then) == figures
    assert same(resumed.state(), learner.state())
    with pytest.raises(ValueError, match=r"does not fit this learner: critic\.trunk\."):
        new_learner(FULL).load(learner.state())


# Checkpoints ----------------------------------------------------------------------------------------------------------

VARIANTS = {
    "mappo": {"method": "mappo"},
    "ippo": {"method": "ippo"},
    "hatrpo": {"method": "hatrpo"},
    "kl_stop": {"kl_stop": 0.02},
    "kl_step": {"kl_step": 0.01},
    "decay": {"decay_steps": 200},
    "shared": {"share_actors": True},
    "shared ippo": {"share_actors": True, "method": "ippo"},
    "shared hatrpo": {"share_actors": True, "method": "hatrpo"},
    "squashed": {"architecture": Architecture((5,), squash=1.5)},
    "state_std": {"architecture": Architecture((5,), state_std=True)},
    "both": {"architecture": Architecture((5,), squash=1.0, state_std=True), "method": "hatrpo"},
    "recurrent": {"architecture": Architecture((5,), recurrent=4), "chunk": 4},
    "recurrent, shared": {
        "architecture": Architecture((5,), recurrent=4, squash=1.0, layer_norm=True),
        "chunk": 2,
        "share_actors": True,
    },
    "recurrent ippo": {"architecture": Architecture((5,), recurrent=4, state_std=True), "chunk": 8, "method": "ippo"},
    "recurrent hatrpo": {"architecture": Architecture((5,), recurrent=4), "chunk": 4, "method": "hatrpo"},
}


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_every_variant_goes_on_from_its_checkpoint_as_if_nothing_had_been(variant, experience, same):
    config = replace(FULL, **variant)
    learner = new_learner(config)
    for seed in range(2):
        learner.update(experience(learner, seed=seed, void=0.1))
    saved = arrays.to_bytes(learner.state())
    then = experience(learner, seed=9)
    figures = learner.update(then)
    resumed = new_learner(config, seed=77)
    resumed.load(arrays.from_bytes(saved))
    assert same(resumed.state(), arrays.from_bytes(saved))
    assert resumed.update(then) == figures
    assert same(resumed.state(), learner.state())
    assert all(np.isfinite(x).all() for x in learner.state().values())


@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_who_is_out_all_the_time_changes_nothing_but_its_own_critic(variant, experience):
    learner = new_learner(replace(PLAIN, **variant))
    batch = experience(learner, seed=3, void=0.1)
    before = [copy.deepcopy(actor) for actor in learner.actors]
    figures = learner.update(batch._replace(alive=[*batch.alive[:2], torch.zeros_like(batch.alive[2])]))
    assert np.isfinite(list(figures.values())).all()
    assert gap(before[0], learner.actors[0]) > 0.0
    assert gap(before[2], learner.actors[2]) == 0.0


def test_settings_that_are_off_leave_no_trace_in_a_checkpoint():
    keys = set(new_learner(PLAIN).state())
    assert {k.split(".")[0] for k in keys} == {"actor", "adam", "critic", "observation_counts", "rng", "value_norm"}
    for name, added in {
        "decay": {"steps"},
        "shared": {"sharing"},
        "kl_step": {f"adam.actor.{i}.lr" for i in range(3)},
    }.items():
        assert set(new_learner(replace(PLAIN, **VARIANTS[name])).state()) - keys == added


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
    before = learner.state()
    with pytest.raises(ValueError, match=named):
        learner.load(new_learner(replace(PLAIN, **VARIANTS[saved])).state())
    assert same(learner.state(), before)


def test_another_limit_is_another_policy():
    small, large = (new_learner(replace(PLAIN, architecture=Architecture((5,), squash=s))) for s in (1.0, 2.0))
    with pytest.raises(ValueError, match=r"actor\.0\.squash"):
        small.load(large.state())


def test_shared_and_single_actors_go_on_from_each_other(experience):
    shared, single = (new_learner(replace(FULL, share_actors=s), seed=1 + s) for s in (True, False))
    for learner in (shared, single):
        learner.update(experience(learner, seed=4))
    theirs = single.state()
    split = new_learner(FULL, seed=9)
    split.inherit([(shared.state(), 1), (shared.state(), 0), (shared.state(), 2)], None)
    assert gap(split.actors[0], shared.actors[0]) == gap(split.actors[1], shared.actors[0]) == 0.0
    assert gap(split.actors[2], shared.actors[2]) == 0.0
    assert split.observation_counts.tolist() == [96, 96, 48, 0]
    joined = new_learner(replace(FULL, share_actors=True), seed=9)
    joined.inherit([(theirs, 1), (theirs, 0), (theirs, 2)], theirs)
    assert gap(joined.actors[0], single.actors[1]) == gap(joined.actors[2], single.actors[2]) == 0.0
    assert joined.observation_counts.tolist() == [48, 48, 48]


# Settings -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("learner", "says"),
    [
        ({"precision": "float16"}, "learner.precision"),
        ({"method": "a2c"}, "learner.method"),
        ({"method": "ippo", "critic_input": "all"}, "ippo's critics see what their own agents see"),
        ({"method": "ippo", "critic_input": "privileged"}, "ippo's critics see what their own agents see"),
        ({"method": "ippo", "critic_input": "same"}, "ippo's critics see what their own agents see"),
        ({"method": "hatrpo", "kl_stop": 0.01}, "learner.kl_stop"),
        ({"method": "hatrpo", "kl_step": 0.01}, "learner.kl_step"),
        ({"kl_step": 0.01, "decay_steps": 10}, "not both"),
        ({"kl_stop": 0.0}, "must be above 0"),
        ({"decay_steps": -1}, "must be at least 0"),
        ({"trust_region": {"backtrack": 1.0}}, "learner.trust_region.backtrack"),
        ({"architecture": {"squash": 0.0}}, "learner.architecture.squash"),
        ({"critic_input": "everything"}, "learner.critic_input"),
    ],
)
def test_settings_that_cannot_be_are_refused_in_one_line(learner, says):
    with pytest.raises(ConfigError) as caught:
        build(Config, {"learner": learner})
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)
