"""HAPPO against the paper's formulas, written here a second time. Batches use γ = 0, so that A = r − V(s)."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from agents.errors import Diverged
from agents.happo import Learner
from agents.settings import Architecture, HappoConfig
from storage import arrays

SMALL = Architecture((5,))
PLAIN = HappoConfig(
    SMALL, lr=0.02, critic_lr=0.05, gamma=0.0, entropy=0.01, epochs=3, minibatches=1, max_grad_norm=0.02,
    fixed_order=True, value_norm=False,
)  # fmt: skip


def new_learner(agents: int, config: HappoConfig = PLAIN, seed: int = 0) -> Learner:
    return Learner([4, 3, 5][:agents], [2, 1, 3][:agents], config, seed)


def critic_of(learner: Learner) -> torch.nn.Module:
    return learner.critic_learners[0].network


def log_density(actor: torch.nn.Module, obs: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
    """log N(a; μ, σ) and the entropy ½ log(2πe σ²), summed over the action's numbers."""
    std = torch.sigmoid(actor.std_logit) * actor.std_scale
    z = (actions - actor.mean(actor.trunk(obs))) / std
    log_probs = (-z * z / 2 - std.log() - math.log(2 * math.pi) / 2).sum(-1)
    return log_probs, (0.5 + math.log(2 * math.pi) / 2 + std.log()).sum()


def adam_step(module: torch.nn.Module, optimizer: torch.optim.Adam, loss: Tensor, max_norm: float) -> None:
    optimizer.zero_grad()
    loss.backward()
    gradients = [p.grad for p in module.parameters() if p.grad is not None]
    norm = math.sqrt(sum(float((g**2).sum()) for g in gradients))
    assert norm > max_norm  # else the clip of gradients would go untested
    for g in gradients:
        g *= max_norm / norm
    optimizer.step()


def ppo(actor: torch.nn.Module, obs: Tensor, actions: Tensor, old: Tensor, A: Tensor, c: HappoConfig) -> float:
    """PPO (Schulman et al., 2017, eq. 7) on the whole batch; returns the share of clipped ratios."""
    optimizer = torch.optim.Adam(actor.parameters(), c.lr, eps=1e-5)
    clipped = 0.0
    for _ in range(c.epochs):
        log_probs, entropy = log_density(actor, obs, actions)
        r = (log_probs - old).exp()
        bound = torch.where(A > 0, torch.full_like(A, 1 + c.clip), torch.full_like(A, 1 - c.clip))
        gain = torch.where(A > 0, torch.minimum(r, bound), torch.maximum(r, bound)) * A
        adam_step(actor, optimizer, -gain.mean() - c.entropy * entropy, c.max_grad_norm)
        clipped = float((gain != r * A).float().mean())
    return clipped


def standardised_advantage(learner: Learner, batch) -> Tensor:
    with torch.no_grad():
        A = (batch.rewards - critic_of(learner)(torch.cat(list(batch.observations), -1))).flatten()
    return (A - A.mean()) / (A.std(correction=0) + 1e-5)


def worst_gap(a: torch.nn.Module, b: torch.nn.Module) -> float:
    return max(float((x - y).detach().abs().max()) for x, y in zip(a.parameters(), b.parameters(), strict=True))


def test_with_one_agent_happo_is_ppo(experience):
    learner = new_learner(1)
    batch = experience(learner, seed=1)
    actor = copy.deepcopy(learner.actors[0])
    flat = [x[0].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs)]
    clipped = ppo(actor, *flat, standardised_advantage(learner, batch), PLAIN)
    before = copy.deepcopy(learner.actors[0])
    learner.update(batch)
    assert 0.1 < clipped < 0.9
    assert worst_gap(actor, learner.actors[0]) < 1e-6
    assert worst_gap(before, learner.actors[0]) > 1e-2


def test_each_agent_learns_from_the_advantage_times_the_ratios_of_those_before_it(experience):
    learner = new_learner(3)
    batch = experience(learner, seed=2)
    expected, without_M = ([copy.deepcopy(a) for a in learner.actors] for _ in range(2))
    A = standardised_advantage(learner, batch)
    M = torch.ones_like(A)
    spread = []
    for i, actor in enumerate(expected):
        obs, actions, old = (x[i].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs))
        before = log_density(actor, obs, actions)[0].detach()
        ppo(actor, obs, actions, old, M * A, PLAIN)
        ppo(without_M[i], obs, actions, old, A, PLAIN)
        M = M * (log_density(actor, obs, actions)[0].detach() - before).exp()
        spread.append(float(M.std()))
    learner.update(batch)
    assert spread[0] > 0.05  # M is not 1 by the time it matters
    for i in range(3):
        assert worst_gap(expected[i], learner.actors[i]) < 1e-6
    assert worst_gap(without_M[1], learner.actors[1]) > 1e-4
    assert worst_gap(without_M[2], learner.actors[2]) > 1e-4


def test_the_team_moves_in_a_fresh_order_each_time_unless_it_is_fixed(experience):
    def first_movers(config: HappoConfig) -> set[int]:
        """Who moved first, in 12 updates: the agent whose update is what it would be alone, without M."""
        movers = set()
        for seed in range(12):
            learner = new_learner(2, config, seed)
            batch = experience(learner, seed=2)
            alone = [copy.deepcopy(a) for a in learner.actors]
            A = standardised_advantage(learner, batch)
            for i, actor in enumerate(alone):
                flat = [x[i].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs)]
                ppo(actor, *flat, A, config)
            learner.update(batch)
            movers |= {i for i in range(2) if worst_gap(alone[i], learner.actors[i]) < 1e-6}
        return movers

    assert first_movers(PLAIN) == {0}
    assert first_movers(replace(PLAIN, fixed_order=False)) == {0, 1}


@pytest.mark.parametrize("value_norm", [False, True])
def test_the_value_loss_is_clipped_and_huber(value_norm, experience):
    config = replace(PLAIN, value_norm=value_norm, huber_delta=0.5, clip=0.05)
    learner = new_learner(2, config)
    batch = experience(learner, seed=3)
    critic = copy.deepcopy(critic_of(learner))
    team = torch.cat(list(batch.observations), -1).flatten(0, 1)
    R = batch.rewards.flatten()  # γ = 0
    target = (R - R.mean()) / R.std(correction=0) if value_norm else R
    old = critic(team).detach()
    optimizer = torch.optim.Adam(critic.parameters(), config.critic_lr, eps=1e-5)
    moved = linear = square = 0

    def huber(error: Tensor) -> Tensor:
        size = error.abs()
        return torch.where(size <= 0.5, size**2 / 2, 0.5 * (size - 0.25))

    for _ in range(config.epochs):
        value = critic(team)
        kept = torch.maximum(torch.minimum(value, old + 0.05), old - 0.05)
        adam_step(
            critic, optimizer, torch.maximum(huber(target - value), huber(target - kept)).mean(), config.max_grad_norm
        )
        moved = int((kept != value).sum())
        linear, square = int(((target - value).abs() > 0.5).sum()), int(((target - value).abs() < 0.5).sum())
    learner.update(batch)
    assert min(moved, linear, square) > 0  # every branch of the formula was taken
    assert worst_gap(critic, critic_of(learner)) < 1e-5
    assert worst_gap(critic_of(new_learner(2)), critic_of(learner)) > 1e-2


FULL = replace(
    PLAIN, gamma=0.97, epochs=2, minibatches=3, fixed_order=False, value_norm=True, normalise_observations=True
)


def test_what_a_void_decision_holds_changes_nothing(experience, same):
    states = []
    for garbage in (None, 1e3, math.nan):
        learner = new_learner(2, FULL)
        batch = experience(learner, seed=4, void=0.2)
        assert 3 < int(batch.void.sum()) < 20
        if garbage is not None:
            for tensor in (*batch.next_observations, *batch.actions, *batch.log_probs, batch.rewards):
                tensor[batch.void] = garbage
            for tensor in batch.observations:
                tensor[batch.void] *= garbage
        learner.update(batch)
        states.append(learner.state())
    assert same(states[0], states[1])
    assert same(states[0], states[2])
    assert all(np.isfinite(array).all() for array in states[0].values())


def living(batch, seed: int):
    """The batch with agents that are out in a third of the decisions, all of them in some."""
    rng = torch.Generator().manual_seed(seed)
    here = [torch.rand(batch.rewards.shape, generator=rng) < 0.67 for _ in range(2 * len(batch.alive))]
    return batch._replace(alive=here[: len(batch.alive)], next_alive=here[len(batch.alive) :])


def test_the_numbers_of_who_is_out_of_the_game_change_nothing(experience, same):
    states = []
    for garbage in (None, 1e3, math.nan):
        learner = new_learner(3, FULL)
        batch = living(experience(learner, seed=4, void=0.1), seed=5)
        if garbage is not None:
            for i, alive in enumerate(batch.alive):
                for tensor in (batch.observations[i], batch.actions[i], batch.log_probs[i]):
                    tensor[~alive] = garbage
                batch.next_observations[i][~batch.next_alive[i]] = garbage
        learner.update(batch)
        states.append(learner.state())
    assert same(states[0], states[1])
    assert same(states[0], states[2])
    assert all(np.isfinite(array).all() for array in states[0].values())


def test_agents_learn_from_what_they_lived_through(experience):
    learner = new_learner(3)
    batch = living(experience(learner, seed=2), seed=7)
    alive = [a.flatten() for a in batch.alive]
    somebody = torch.stack(alive).any(0)
    assert 0 < int((~somebody).sum()) < 10
    team = torch.cat([o * a[..., None] for o, a in zip(batch.observations, batch.alive, strict=True)], -1)
    with torch.no_grad():
        A = (batch.rewards - critic_of(learner)(team)).flatten()
    A = (A - A[somebody].mean()) / (A[somebody].std(correction=0) + 1e-5)
    expected, M = [copy.deepcopy(a) for a in learner.actors], torch.ones_like(A)
    for i, actor in enumerate(expected):
        obs, actions, old = (x[i].flatten(0, 1)[alive[i]] for x in (batch.observations, batch.actions, batch.log_probs))
        before = log_density(actor, obs, actions)[0].detach()
        ppo(actor, obs, actions, old, (M * A)[alive[i]], PLAIN)
        M[alive[i]] *= (log_density(actor, obs, actions)[0].detach() - before).exp()
    learner.update(batch)
    for one, other in zip(expected, learner.actors, strict=True):
        assert worst_gap(one, other) < 1e-6


def test_who_was_out_all_the_time_stays_as_it_was(experience):
    learner = new_learner(2, FULL)
    batch = experience(learner, seed=4)
    before = [copy.deepcopy(actor) for actor in learner.actors]
    learner.update(batch._replace(alive=[batch.alive[0], torch.zeros_like(batch.alive[1])]))
    assert worst_gap(before[0], learner.actors[0]) > 1e-3
    assert worst_gap(before[1], learner.actors[1]) == 0.0
    assert learner.observation_counts.tolist() == [48, 0, 48]


def test_nothing_but_void_decisions_is_no_update(experience, same):
    learner = new_learner(2, FULL)
    before = learner.state()
    batch = experience(learner, seed=4)
    assert learner.update(batch._replace(void=torch.ones_like(batch.void))) == {}
    assert same(before, learner.state())


def test_a_minibatch_in_which_nothing_counts_changes_nothing(experience):
    """With one known decision, two of three minibatches are empty: the third does what the whole batch would."""
    learner, whole = (new_learner(2, replace(FULL, minibatches=m, fixed_order=True)) for m in (3, 1))
    batch = experience(learner, seed=4)
    only = torch.ones_like(batch.void)
    only[3, 2] = False
    figures = [each.update(batch._replace(void=only)) for each in (learner, whole)]
    assert figures[0] == pytest.approx(figures[1], rel=1e-5)
    states = [each.state() for each in (learner, whole)]
    for name in states[0].keys() - {"rng"}:
        np.testing.assert_allclose(states[0][name], states[1][name], rtol=1e-6, atol=1e-7, err_msg=name)
    steps = {array.item() for name, array in states[0].items() if name.endswith(".step")}
    assert steps == {FULL.epochs}
    assert states[0]["value_norm.weight"] == pytest.approx(2e-5, rel=1e-4)
    assert max(worst_gap(a, b) for a, b in zip(learner.actors, new_learner(2, FULL).actors, strict=True)) > 1e-3


def test_observation_statistics_are_those_of_all_that_was_seen(experience):
    learner = new_learner(2, FULL)
    batches = [experience(learner, seed=s, N=n) for s, n in ((5, 3), (6, 8))]
    batches[1].observations[0].mul_(3.0).add_(5.0)
    for batch in batches:
        learner.update(batch)
    seen = [torch.cat([b.observations[i].flatten(0, 1) for b in batches]) for i in range(2)]
    trunks = [*(actor.trunk for actor in learner.actors), critic_of(learner).trunk]
    for trunk, obs in zip(trunks, [*seen, torch.cat(seen, -1)], strict=True):
        torch.testing.assert_close(trunk.observation_mean, obs.mean(0), atol=1e-4, rtol=1e-5)
        torch.testing.assert_close(trunk.observation_var, obs.var(0, correction=0), atol=1e-4, rtol=1e-4)


def with_garbage(batch, field: str, garbage: float, agent: int = 1):
    """The batch with one number of a valid decision spoilt."""
    tensors = getattr(batch, field)
    at = tuple(torch.nonzero(~batch.void)[7])
    (tensors if field == "rewards" else tensors[agent])[at] = garbage
    return batch


@pytest.mark.parametrize("update", [Learner.update, Learner.update_critic_only])
@pytest.mark.parametrize(
    ("field", "garbage", "named"),
    [
        ("rewards", math.nan, "not finite: rewards"),
        ("actions", math.nan, "agent 1's actions"),
        ("actions", math.inf, "agent 1's actions"),
        ("log_probs", -math.inf, "agent 1's log densities"),
    ],
)
def test_what_no_update_can_learn_from_is_refused_before_anything_changes(
    field, garbage, named, update, experience, same
):
    learner = new_learner(2, FULL)
    before = learner.state()
    with pytest.raises(Diverged, match=named):
        update(learner, with_garbage(experience(learner, seed=4, void=0.2), field, garbage))
    assert same(before, learner.state())


def test_a_broken_policy_is_noticed_though_it_makes_every_world_void(experience):
    learner = new_learner(2, FULL)
    batch = experience(learner, seed=4)
    with torch.no_grad():
        learner.actors[1].mean.weight[0, 0] = math.nan
    for update in (learner.update, learner.update_critic_only):
        with pytest.raises(Diverged, match=r"actor\.1\.mean\.weight"):
            update(batch._replace(void=torch.ones_like(batch.void)))


def test_losses_and_gradients_that_overflow_are_named(experience):
    learner = new_learner(2)
    batch = experience(learner, seed=4)
    batch.log_probs[0].sub_(200.0)  # ratios of e²⁰⁰
    with pytest.raises(Diverged, match=r"not finite: policy_loss, entropy, ratio and 2 more"):
        learner.update(batch)
    batch.rewards.mul_(1e25)
    with pytest.raises(Diverged, match="not finite: value_loss, critic_grad_norm"):
        new_learner(2, replace(PLAIN, huber_delta=1e30)).update_critic_only(batch)


def test_weights_that_overflow_are_noticed_in_the_update_that_made_them_so(experience):
    learner = new_learner(2, replace(PLAIN, critic_lr=1e30, epochs=1))
    (critic,) = learner.critic_learners
    critic.optimizer.state[critic.network.value.bias]["exp_avg"].fill_(1e15)
    with pytest.raises(Diverged, match=r"not finite: critic\.value\.bias$"):
        learner.update(experience(learner, seed=4))


def test_a_resting_team_keeps_its_policy_while_its_critic_follows(experience, same):
    config = replace(FULL, minibatches=1, fixed_order=True)
    resting, playing = (new_learner(2, config) for _ in range(2))
    batch = experience(resting, seed=4, void=0.2)
    before = resting.state()
    figures = resting.update_critic_only(batch)
    assert figures.keys() == {"value_loss", "critic_grad_norm", "explained_variance"}
    assert figures["value_loss"] == pytest.approx(playing.update(batch)["value_loss"], rel=1e-4)

    after = resting.state()
    policy = [name for name in after if "actor." in name or "observation_" in name]
    assert same([before[name] for name in policy], [after[name] for name in policy])
    assert worst_gap(critic_of(resting), critic_of(playing)) < 1e-5
    assert worst_gap(critic_of(new_learner(2, config)), critic_of(resting)) > 1e-2
    for name, seen in resting.critic_learners[0].value_norm.state_dict().items():
        assert seen != 0
        torch.testing.assert_close(seen, playing.critic_learners[0].value_norm.state_dict()[name])


def test_figures_are_those_of_the_textbooks(experience):
    still = replace(PLAIN, lr=1e-12, critic_lr=1e-12, epochs=1)
    learner = new_learner(1, still)
    batch = experience(learner, seed=4)
    figures = learner.update(batch)
    obs, actions, old = (x[0].flatten(0, 1) for x in (batch.observations, batch.actions, batch.log_probs))
    log_probs, entropy = log_density(learner.actors[0], obs, actions)
    r = (log_probs - old).exp()
    values = critic_of(learner)(obs).detach()
    expected = {
        "ratio": r.mean(),
        "kl": (r - 1 - r.log()).mean(),
        "entropy": entropy,
        "explained_variance": 1 - (batch.rewards.flatten() - values).var() / batch.rewards.var(),
    }
    for name, value in expected.items():
        assert figures[name] == pytest.approx(value.item(), rel=1e-4), name
    norm = math.sqrt(sum(float((p.grad**2).sum()) for p in learner.actors[0].parameters()))  # scaled down by then
    assert norm == pytest.approx(PLAIN.max_grad_norm, rel=1e-3)
    assert figures["actor_grad_norm"] > 1.1 * PLAIN.max_grad_norm
    assert figures["critic_grad_norm"] > 1.1 * PLAIN.max_grad_norm


@pytest.mark.parametrize("updates", [0, 2])
def test_going_on_from_a_checkpoint_is_going_on(updates, experience, same):
    learner = new_learner(2, FULL)
    first = [experience(learner, seed=s) for s in range(updates)]
    for batch in first:
        learner.update(batch)
    checkpoint = arrays.to_bytes(learner.state())
    then = experience(learner, seed=9)
    diagnostics = learner.update(then)

    resumed = new_learner(2, FULL, seed=123)
    assert not same(resumed.state(), arrays.from_bytes(checkpoint))
    resumed.load(arrays.from_bytes(checkpoint))
    assert same(resumed.state(), arrays.from_bytes(checkpoint))
    assert resumed.update(then) == diagnostics
    assert same(resumed.state(), learner.state())


def test_a_state_is_a_copy(experience):
    learner = new_learner(1, FULL)
    state = learner.state()
    before = {name: array.copy() for name, array in state.items()}
    learner.update(experience(learner, seed=1))
    for name, array in state.items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (lambda s: s.pop("critic.value.weight"), r"critic\.value\.weight \(1 in all\)"),
        (lambda s: s.pop("rng"), r"rng \(1 in all\)"),
        (lambda s: s.update({"actor.1.activation": np.int32(2)}), r"actor\.1\.activation \(1 in all\)"),
        (lambda s: s["critic.value.weight"].fill(np.nan), r"not finite in critic\.value\.weight \(1 in all\)"),
        (
            lambda s: s.update(new_learner(2, replace(PLAIN, architecture=Architecture((6,)))).state()),
            "hidden.0.weight",
        ),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused_whole(spoil, named, same):
    learner, state = new_learner(2, seed=1), new_learner(2, seed=2).state()
    before = learner.state()
    spoil(state)
    with pytest.raises(ValueError, match=named):
        learner.load(state)
    assert same(before, learner.state())


def test_learners_are_made_from_their_own_seed_alone(same):
    torch.manual_seed(1)
    following = torch.rand(3)
    torch.manual_seed(1)
    learner = new_learner(2, seed=7)
    assert torch.equal(torch.rand(3), following)
    assert same(learner.state(), new_learner(2, seed=7).state())
    assert not same(learner.state(), new_learner(2, seed=8).state())
