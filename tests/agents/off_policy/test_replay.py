"""The ring of decisions: what is where, what is drawn, and what is forgotten."""

import pytest
import torch

from agents.batch import CriticView
from agents.off_policy.replay import Layout, Replay, more_size, multi_step_returns, valid_rows
from tests.agents.off_policy.conftest import AGENTS, CPU, experience

SIZES = [a.observation_size for a in AGENTS], [a.action_size for a in AGENTS]


def numbered(first: int, count: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rows of one number each, all valid, whose opponents are numbers too: one for each ten rows."""
    rows = torch.arange(first, first + count, dtype=torch.float32)[:, None]
    return rows, torch.ones(count, dtype=torch.bool), (rows[:, 0] // 10).long()


def drawn(replay: Replay, count: int = 20_000) -> torch.Tensor:
    """The number of times that each number is drawn."""
    places = replay.draw(count, torch.Generator().manual_seed(3))
    return torch.bincount(replay.rows[places, 0].long(), minlength=60)


def test_a_ring_replaces_the_oldest_and_draws_all_that_it_holds_alike():
    replay = Replay(30, 1, CPU)
    for first in (0, 20, 40):
        replay.append(*numbered(first, 20))
    counts = drawn(replay)
    assert not counts[:30].any()  # 60 came, 30 are held
    assert ((counts[30:] - 20_000 / 30).abs() < 5 * (20_000 / 30) ** 0.5).all()
    assert (replay.usable, replay.at) == (30, 0)


def test_of_more_rows_than_fit_the_last_ones_stay():
    replay = Replay(7, 1, CPU)
    replay.append(*numbered(0, 5))
    replay.append(*numbered(5, 20))
    assert sorted(replay.rows[:, 0].tolist()) == list(range(18, 25))


def test_what_is_not_valid_is_never_drawn():
    replay, (rows, valid, tags) = Replay(30, 1, CPU), numbered(0, 20)
    replay.append(rows, valid & (rows[:, 0] % 3 == 0), tags)
    counts = drawn(replay)
    assert set(counts.nonzero()[:, 0].tolist()) == {0, 3, 6, 9, 12, 15, 18}
    assert replay.any_valid == 1
    replay.append(rows, torch.zeros_like(valid), tags)
    replay.append(rows, torch.zeros_like(valid), tags)
    assert replay.any_valid == 0
    assert (replay.draw(5, torch.Generator()) < 30).all()


def test_decisions_against_others_are_dropped():
    replay = Replay(50, 1, CPU)
    replay.append(*numbered(0, 50))
    replay.keep([1, 4, 77])
    counts = drawn(replay)
    assert counts.nonzero()[:, 0].tolist() == [*range(10, 20), *range(40, 50)]
    assert replay.usable == 20


def test_a_saved_ring_goes_on_alike():
    one, other = Replay(30, 1, CPU), Replay(30, 1, CPU)
    for first in (0, 20):
        one.append(*numbered(first, 20))
    one.keep([1, 2, 3])
    other.append(*numbered(0, 5))  # is replaced
    other.load(**{name: tensor.clone() for name, tensor in one.saved().items()})
    for replay in (one, other):
        replay.append(*numbered(40, 7))
    assert torch.equal(drawn(one), drawn(other))
    assert (one.usable, one.at, one.written) == (other.usable, other.at, other.written)


@pytest.mark.parametrize(("capacity", "held"), [(20, range(20, 40)), (50, range(10, 40))])
def test_a_ring_of_another_size_takes_over_the_newest(capacity, held):
    small, other = Replay(30, 1, CPU), Replay(capacity, 1, CPU)
    for first in (0, 20):
        small.append(*numbered(first, 20))
    other.load(**small.saved())
    assert drawn(other).nonzero()[:, 0].tolist() == list(held)
    other.append(*numbered(50, 5))
    kept = [*held, *range(50, 55)][-capacity:]
    assert drawn(other).nonzero()[:, 0].tolist() == kept


@pytest.mark.parametrize("sees", ["own", "others", "whole"])
def test_a_row_holds_all_of_a_decision(sees):
    batch, rng = experience(1), torch.Generator().manual_seed(2)
    now, then = torch.randn(2, 8, 6, 5, generator=rng)
    if sees == "others":
        batch = batch._replace(others=[now[..., :2], now[..., 2:]], next_others=[then[..., :2], then[..., 2:]])
    if sees == "whole":
        own, own_next = (torch.cat(list(x), -1) for x in (batch.observations, batch.next_observations))
        view = CriticView(
            torch.cat([own, now], -1), torch.cat([own_next, then], -1), batch.rewards, batch.terminated, batch.void
        )
        batch = batch._replace(critic_views=[view])
    layout = Layout(*SIZES, more_size(batch))
    rows = layout.rows(batch, 0.9)
    assert rows.shape == (48, layout.width)
    found = layout.decisions(rows)
    for i in range(2):
        assert torch.equal(found.observations[i], batch.observations[i].flatten(0, 1))
        assert torch.equal(found.next_observations[i], batch.next_observations[i].flatten(0, 1))
        assert torch.equal(found.alive[:, i].bool(), batch.alive[i].flatten())
        assert torch.equal(found.next_alive[:, i].bool(), batch.next_alive[i].flatten())
    assert torch.equal(found.actions, torch.cat(list(batch.actions), -1).flatten(0, 1))
    assert torch.equal(found.rewards, batch.rewards.flatten())
    torch.testing.assert_close(found.discounts, 0.9 * (~batch.terminated).flatten().float())
    if sees != "own":
        assert torch.equal(found.more, now.flatten(0, 1))
        assert torch.equal(found.next_more, then.flatten(0, 1))


@pytest.mark.parametrize("steps", [1, 3, 20])
def test_returns_are_those_of_a_walk_through_each_episode(steps):
    batch, gamma = experience(4, T=9, N=30), 0.9
    found = multi_step_returns(batch, gamma, steps)
    ends = set()
    for n in range(30):
        for t in range(9):
            total, k = 0.0, t
            while True:
                total += gamma ** (k - t) * batch.rewards[k, n].item()
                over = bool(batch.terminated[k, n] | batch.truncated[k, n] | batch.void[k, n])
                if over or k + 1 == min(9, t + steps) or batch.void[k + 1, n]:
                    break
                k += 1
            ends.add(k - t)
            future = 0.0 if batch.terminated[k, n] else gamma ** (k - t + 1)
            assert found.rewards[t, n].item() == pytest.approx(total, abs=1e-5)
            assert found.discounts[t, n].item() == pytest.approx(future, abs=1e-6)
            assert found.last[t, n] == k
    assert max(ends) == min(steps, 9) - 1
    layout = Layout(*SIZES, 0)
    rows = layout.decisions(layout.rows(batch, gamma, steps))
    for i in range(2):
        then = torch.stack([batch.next_observations[i][found.last[t, n], n] for t in range(9) for n in range(30)])
        assert torch.equal(rows.next_observations[i], then)
        alive = torch.stack([batch.next_alive[i][found.last[t, n], n] for t in range(9) for n in range(30)])
        assert torch.equal(rows.next_alive[:, i].bool(), alive)


def test_void_decisions_and_those_without_an_agent_do_not_count():
    batch = experience(5, T=40, N=40, void=0.3, dead=0.5)
    valid = valid_rows(batch)
    expected = ~batch.void & (batch.alive[0] | batch.alive[1])
    assert torch.equal(valid, expected.flatten())
    assert 0.4 < valid.float().mean() < 0.65
