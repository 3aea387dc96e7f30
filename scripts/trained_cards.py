"""Results of every policy that comes with the league in every arena that accepts it, on the C engine, for its card.

    python -m scripts.trained_cards --episodes 64 --output benchmarks/results/trained-cpu.json --cards
    python -m scripts.trained_cards --arenas soccer-1v1 --output raw.json --raw

An arena accepts a policy if one of its teams has the policy's roster. With default settings these are the arenas of its
robots; if the arena in which it was trained accepts it only with other settings, or if an action means another speed or
angle with them, these are tried too, or instead. In an arena of
two teams, each policy plays the shipped policies that fit the other team, and the script `idle`.

`--cards` writes the table of each policy into its card, between two marks. `--raw` keeps the input weights that are
otherwise removed in other arenas (`agents.policy.constant_inputs`), for comparison.
"""

import argparse
import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import arenas
from arenas.arena import Settings
from arenas.description import Outline
from arenas.rosters import AgentSizes, roster_text
from league.config import experiment as configuration
from league.config.experiment import Config
from league.matches.evaluator import MatchEvaluator
from league.queries.arena_info import outline
from league.queries.query import Open, score_text
from league.runtime.bootstrap import create
from league.scheduling.progress_metrics import can_meet
from league.snapshots import policy_file
from league.snapshots.transfer.arena_transfer import changed_actions_of
from league.state.jobs import RatingMatch
from league.system.packages.versions import versions
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.scores import Score
from storage.records import Match
from storage.store import Store

LEAGUE = "tried"
MARKS = "<!-- written by python -m scripts.trained_cards -->", "<!-- until here -->"
SCRIPT = "idle"  # opponent of every policy: one that does not win against it does nothing


def rosters(outline: Outline) -> list[str]:
    """Return the rosters of an arena's teams."""
    return [roster_text(AgentSizes(*seat) for seat in seats) for seats in outline.teams.values()]


def candidates(policies: Mapping[str, policy_file.Policy]) -> dict[str, tuple[Settings, list[str]]]:
    """Return title -> (settings of an arena, names of the policies that it accepts)."""
    found: dict[str, tuple[Settings, list[str]]] = {}
    odd = {t for t, p in policies.items() if has_changed_actions(p, arenas.settings(p.about["arena"]["arena"]))}
    for name, settings in arenas.known().items():
        fit = [t for t, p in policies.items() if p.about["roster"] in rosters(outline(settings)) and t not in odd]
        if fit:
            found[name] = settings, fit
    own: dict[Any, list[str]] = {}
    for title, policy in policies.items():
        settings = configuration.loads(policy.about["settings"]).arena
        if settings.name not in found or title not in found[settings.name][1]:
            own.setdefault(settings, []).append(title)
    for settings, fit in own.items():
        others = [
            t for t, p in policies.items()
            if p.about["roster"] in rosters(outline(settings)) and not has_changed_actions(p, settings)
        ]  # fmt: skip
        found[f"{settings.name} as {' and '.join(fit)} learnt it"] = settings, others
    return found


def has_changed_actions(policy: policy_file.Policy, settings: Settings) -> bool:
    """Return whether an action of a policy means another speed or angle in an arena than where it learnt."""
    rules = (getattr(own, "rules", None) for own in (configuration.loads(policy.about["settings"]).arena, settings))
    if len({*rules}) == 1:  # so nothing has to be built
        return False
    return any(changed_actions_of(policy, configuration.dumps(Config(arena=settings))))


def pairs(store: Store, fit: list[str]) -> Iterator[tuple[str, str | None]]:
    """Yield pairs of a policy and its opponent; the opponent is None in an arena of one team."""
    players, snapshots = store.players(LEAGUE), {s.name: s for s in store.snapshots(LEAGUE)}
    if len({p.team for p in players}) == 1:
        yield from ((name, None) for name in fit)
        return
    idle = [s.name for s in snapshots.values() if s.script == SCRIPT]
    for number, name in enumerate(fit):
        for other in (*fit[number + 1 :], *idle):
            if can_meet(snapshots[name], snapshots[other], players):
                yield name, other


def tried(
    settings: Settings, fit: list[str], policies: Mapping[str, policy_file.Policy], asked: argparse.Namespace
) -> list:
    """Play the matches of these policies in an arena; return (arena key, match) of each."""
    config = Config(arena=settings, league=LEAGUE, engine="c")
    config = replace(config, rating=replace(config.rating, trained=False, record=False, scripts=None))
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, settings.build(engine="c", worlds=1))
        for name in fit:
            policy = policies[name]
            policy_file.bring_in(
                Open(store, LEAGUE),
                policy._replace(about={**policy.about, "arena": None}) if asked.raw else policy,
                name,
            )
        meet = tuple(pairs(store, fit))
        worlds = asked.episodes * len(meet)
        config = replace(config, rating=replace(config.rating, pairings=len(meet), worlds=worlds))
        evaluator = MatchEvaluator(config, settings.build(engine="c", worlds=worlds), LEAGUE)
        return [(evaluator.key, match) for match in evaluator.play(store, RatingMatch(meet, asked.seed, record=False))]


def result_of(policy: str, match: Match) -> tuple[str, Score]:
    """Return a policy's opponent and score in a match; in an arena of one team "" and the share of successes."""
    ladder = Ladder((), [match])
    if match.b is None:
        return "", ladder.success(policy)
    other = match.b if policy == match.a else match.a
    return other, ladder.score(policy, other)


def rows(title: str, fit: list[str], found: list) -> Iterator[dict[str, Any]]:
    """Yield a row of results for each policy and opponent."""
    for key, match in found:
        for policy in (name for name in (match.a, match.b) if name in fit):
            against, score = result_of(policy, match)
            row = {"policy": policy, "arena": title, "rules": key.config_hash, "against": against}
            row |= {"text": score_text(score), "score": round(score.score, 4), "games": score.games}
            row |= {"low": round(score.low, 4), "high": round(score.high, 4), "voids": match.voids}
            yield row if match.b is None else row | {"draws": match.draws}


def table(found: list[dict[str, Any]], learnt: str) -> str:
    """Format a policy's rows as a section of its card."""
    lines = [
        "## In the arenas that accept it",
        "On the C engine. Of one team alone the successes, else the score with draws half, each with its 95 % interval."
        f" It learnt in {learnt}; elsewhere it plays as a warm start would: inputs that never moved there say nothing.",
        "| arena | against | score | draws | void |\n|---|---|---|---|---|",
    ]
    cells = [
        f"| {r['arena']} | {r['against'] or 'nobody'} | {r['text']} | {r.get('draws', '')} | {r['voids']} |"
        for r in found
    ]
    return "\n\n".join(lines) + "\n" + "\n".join(cells)


def write_card(path: Path, text: str) -> None:
    """Write the section at the end of a card, replacing an earlier one."""
    begin, end = MARKS
    kept = re.sub(f"{re.escape(begin)}.*{re.escape(end)}\n?", "", path.read_text(), flags=re.S).rstrip()
    path.write_text(f"{kept}\n\n{begin}\n\n{text}\n\n{end}\n")


def main() -> None:
    """Play all matches, print a line for each, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=64, help="of each pair; even")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--arenas", nargs="*", help="only these")
    parser.add_argument("--raw", action="store_true", help="keep all input weights in every arena")
    parser.add_argument("--output", type=Path, help="JSON; keeps its rows of other arenas")
    parser.add_argument("--cards", action="store_true", help="write the tables into the cards, from the output's rows")
    asked = parser.parse_args()
    policies = {name: policy_file.read(policy_file.find(name)) for name in policy_file.trained()}
    kept = json.loads(asked.output.read_text())["rows"] if asked.output and asked.output.exists() else []
    for title, (settings, fit) in candidates(policies).items():
        if asked.arenas and not {settings.name, title} & set(asked.arenas):
            continue
        found = list(rows(title, fit, tried(settings, fit, policies, asked)))
        kept = [row for row in kept if row["arena"] != title] + found
        for row in found:
            print(f"{title}: {row['policy']} {row['against']} {row['text']}, {row['voids']} void", flush=True)
        if asked.output:
            about = {"episodes": asked.episodes, "seed": asked.seed, "raw": asked.raw, "versions": versions()}
            asked.output.write_text(json.dumps(about | {"rows": kept}, indent=1) + "\n")
    for name, policy in policies.items() if asked.cards else ():
        own = sorted((row for row in kept if row["policy"] == name), key=lambda row: (row["arena"], row["against"]))
        write_card(policy_file.TRAINED / f"{name}.safetensors.md", table(own, policy.about["arena"]["arena"]))


if __name__ == "__main__":
    main()
