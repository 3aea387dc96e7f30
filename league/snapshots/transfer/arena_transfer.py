"""Policies that play in another arena than the one in which they learnt.

They play as a warm start from them would begin (`league.snapshots.transfer.warm_start`): inputs that were constant
where they learnt are ignored (`agents.policy.constant_inputs`). Else each such input, divided by a deviation of zero,
would be at its limit. Networks that encode sets of entities play where robots see other numbers of them
(`agents.policy.entity_places`), in teams of other sizes. Actions stay as they are, also where the same number now means
another speed or angle: `changed_actions` tells of it.
"""

from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from agents.policy import entity_places
from agents.policy.constant_inputs import is_constant, silence_constant_inputs
from arenas.description import Part
from arenas.rosters import bare, matching_roster, roster_agents
from dashboards.untrusted_text import visible
from league.config import experiment as configuration
from league.queries.query import Open
from league.snapshots.policy_file import ExchangeError, Policy, arena_name, bring_in, find, read, trained
from league.snapshots.transfer.home_arena import described_arena
from storage.records import Snapshot

if TYPE_CHECKING:
    from arenas.arena import Arena, Settings


def elsewhere(snapshot: Snapshot, arena: "Arena") -> bool:
    """Return whether a policy learnt in an arena with other rules or bodies; False if its arena is not known."""
    return snapshot.arena is not None and snapshot.arena.config_hash != arena.config_hash


class Played(NamedTuple):
    """A policy as a league plays it."""

    policy: Policy
    silenced: bool  # whether inputs that were constant where it learnt are ignored
    note: str  # about them; empty if it plays as it learnt


def as_played(league: Open, policy: Policy) -> Played:
    """Return a policy of a league with the arrays with which it plays there, as `league.snapshots.codec.thaw` does.

    To know whether it learnt under other rules, the league's arena is built, which takes a second or two, unless all
    its inputs moved. Where the arena cannot be built the policy stays as it is.
    """
    learnt, numbers = policy.about["arena"], range(len(policy.about["agents"]))
    own = [{k.removeprefix(f"{i}/"): v for k, v in policy.arrays.items() if k.startswith(f"{i}/")} for i in numbers]
    silent = {f"{i}/{k}": v for i, each in enumerate(own) for k, v in silence_constant_inputs(each).items()}
    if learnt is None or all(np.array_equal(silent[name], array) for name, array in policy.arrays.items()):
        return Played(policy, False, "")
    here, title = arena_name(league), f"league {league.league}"
    settings = league.store.league(league.league).config
    arena, error = described_arena(settings) if here else (None, "its settings name none")
    if arena is None:
        note = f"Whether it learnt under the rules of {title} is not known: the league's arena cannot be built here"
        return Played(policy, False, f"{note} ({visible(error)}): all files are of the policy as it learnt.")
    if arena.config_hash == learnt["config_hash"]:
        return Played(policy, False, "")
    other = "under other rules" if learnt["arena"] == here else f"and {title} plays {here}"
    note = (
        f"It learnt in {learnt['arena']}, {other}: as in the matches of {title}, inputs that never moved there have no"
        " effect in ONNX, TorchScript and the lines of NumPy; the safetensors file has the policy as it learnt."
    )
    return Played(policy._replace(arrays=silent), True, note)


def describe_transfer(league: Open, policy: Policy) -> str:
    """Return a note about an imported policy that learnt in another arena than the league's, else an empty text.

    This compares names of arenas and the meaning of actions, and of rules nothing else.
    """
    learnt, here = (policy.about["arena"] or {}).get("arena"), arena_name(league)
    if learnt is None or here == "":
        return ""
    lines = list(changed_actions_of(policy, league.store.league(league.league).config))
    if here != learnt:
        still, every = np.sum([_inputs(policy.arrays, f"{i}/") for i in range(len(policy.about["agents"]))], axis=0)
        silent = f": {still} of its {every} inputs never moved there, and say nothing to it here."
        lines.insert(0, f"It learnt in {learnt}{silent if still else ', where all its inputs moved.'}")
    return "\n".join(lines)


def bring_in_trained(league: Open, arena: "Arena") -> None:
    """Add the policies that come with the league and learnt in this arena, if they fit and their name is free.

    Left out are those to which an action means another speed or angle here: they would play worse than they learnt.
    """
    players, here = league.store.players(league.league), league.store.league(league.league).config
    taken = {p.name for p in players} | {s.name for s in league.store.snapshots(league.league)}
    for name in trained():
        policy = read(find(name))
        learnt = policy.about["arena"] or {}
        if learnt.get("arena") != arena.name or name in taken:
            continue
        fits = matching_roster(policy.about["roster"], (p.roster for p in players))
        if fits and (learnt["config_hash"] == arena.config_hash or not any(changed_actions_of(policy, here))):
            bring_in(league, policy, name)


def changed_actions_of(policy: Policy, here: str) -> Iterator[str]:
    """Yield a line for each kind of robot of a policy, as `changed_actions` does."""
    return changed_actions(policy.about["settings"], here, {kind for kind, _ in _kinds(policy.about["roster"])})


def changed_actions(learnt: str, here: str, kinds: Collection[str]) -> Iterator[str]:
    """Yield a line for each of these kinds of robot to which an action means something else than where it learnt.

    `learnt` and `here` are settings of leagues, as TOML. Arenas whose settings differ are built, which takes a second
    or two. Of an arena that cannot be built here nothing is known.
    """
    try:
        there, own = (configuration.loads(text).arena for text in (learnt, here))
        known = (_actions(there), _actions(own)) if there != own else ({}, {})
    except (Exception, SystemExit):  # the arena may be a stranger's file
        return
    was, now = known
    for kind in [kind for kind in now if kind in was and kind in kinds]:
        changes = [
            f"{new.name} was {old.meaning}, and is {new.meaning}"
            for old, new in zip(was[kind], now[kind], strict=False)
            if (old.name, old.size) == (new.name, new.size) and old.meaning != new.meaning
        ]
        if changes:
            told = "; ".join(changes)
            yield f"An action of the {kind} means something else here than in {there.name}, where it learnt: {told}."


def _actions(settings: "Settings") -> dict[str, tuple[Part, ...]]:
    """Return the description of the actions of each kind of robot of an arena."""
    arena = settings.build(engine="c", threads=1)
    return {agent.kind: arena.robots[agent.name].action_parts for agent in arena.agents}


def refitted(league: Open, policy: Policy) -> Policy:
    """Return a policy for a league in which its robots see other numbers of entities, or are more or fewer.

    A policy that fits a side of the league stays as it is, and so does one whose networks encode no sets or whose
    robots are none of the league's. Else the agents of a side take its agents of their kind in turn, and the league's
    arena is built, which tells the places of entities. Raises ExchangeError, one line, if the sets differ in more than
    numbers of entities.
    """
    rosters = list(dict.fromkeys(p.roster for p in league.store.players(league.league)))
    learnt = policy.about["roster"]
    alike = [roster for roster in rosters if _kinds(roster) == _kinds(learnt)]
    encoded = all("entities" in agent for agent in policy.about["agents"])
    if matching_roster(learnt, rosters) or len(alike) != 1 or not encoded:
        return policy
    arena = configuration.loads(league.store.league(league.league).config).arena.build()
    team = next(team for team in arena.teams if bare(team.roster) == bare(alike[0]))
    taken, found = Counter[str](), dict[str, np.ndarray]()
    kinds = [agent["kind"] for agent in policy.about["agents"]]
    for number, agent in enumerate(team.agents):
        able = [i for i, kind in enumerate(kinds) if kind == agent.kind]
        source = able[taken[agent.kind] % len(able)]
        taken[agent.kind] += 1
        own = {k.removeprefix(f"{source}/"): v for k, v in policy.arrays.items() if k.startswith(f"{source}/")}
        try:
            new = entity_places.refitted(
                own, "", entity_places.places([each.places for each in agent.entities], agent.observation_size)
            )
        except ValueError as error:
            raise ExchangeError(f"The policy is for {learnt}, and the league has {alike[0]}: {error}.") from None
        found |= {f"{number}/{name}": array for name, array in new.items()}
    return Policy(found, {**policy.about, "roster": alike[0]})


def _kinds(roster: str) -> set[tuple[str, str]]:
    """Return the kinds of a roster's agents, each with the size of its actions."""
    return {(agent.partition(":")[0], agent.rpartition(":")[2]) for agent in roster_agents(roster)}


def _inputs(found: Mapping[str, np.ndarray], agent: str) -> tuple[int, int]:
    """Return the number of constant inputs of an agent, and the number of all its inputs."""
    rests = is_constant(found, agent)
    return int(rests.sum()), rests.size
