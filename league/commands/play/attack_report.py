"""The report of `league exploit`, as text and as JSON: of one attacker, and of several with the best and the median."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dashboards.tables import Column, render
from dashboards.text import clock
from league.matches.adhoc_matches import Pairing
from league.matches.exploitability import Attack, Finding
from league.queries.query import score_text
from storage.records import Snapshot

Views = Mapping[str, tuple[int, int, int]]  # how the victim saw its opponent -> its wins, draws and losses
OUTCOMES = ("win", "draw", "loss")


@dataclass(frozen=True)
class Attacked:
    """An attack that ended: the attacker, its snapshots so far by name, and its games against the victim."""

    chosen: Attack
    pair: Pairing  # of attacker and victim, in the victim's league
    lineage: tuple[str, ...]
    found: Finding
    views: Views

    @property
    def victim(self) -> str:
        """Name of the snapshot that was attacked."""
        return self.chosen.victim.name

    @property
    def attacker(self) -> Snapshot:
        """The attacker, as a player of the victim's league."""
        return self.pair.a

    @property
    def score(self) -> float:
        """The attacker's score; below 0 if all its games were void."""
        return self.found.score.score if self.found.score.games else -1.0


def best_of(attacks: Sequence[Attacked]) -> Attacked:
    """Return the attack whose attacker has the highest score, the first of those that are equal."""
    return max(attacks, key=lambda each: each.score)


def text(made: Attacked) -> str:
    """Return the report of one attack, for people."""
    lines = [*_finding_lines(made.victim, made.attacker.name, made.found)]
    if len(made.views) > 1:
        percent = [_percent(row) for row in _view_rows(made.views)]
        columns = (Column("victim", title=made.victim), Column("games"), *(Column(k, f"{k} %", 1) for k in OUTCOMES))
        lines.append(render(percent, columns))
    return "\n".join([
        *lines,
        f"Lineage: {' -> '.join(made.lineage)} of league {made.chosen.config.league}; {made.attacker.step:,} steps,"
        f" {clock(made.attacker.seconds)} of training against {made.victim} alone.",
        f"{made.attacker.name} is now a fixed player of league {made.pair.opened.league}.",
    ])  # fmt: skip


def text_of_several(attacks: Sequence[Attacked], fresh: Finding) -> str:
    """Return the report of attackers of one victim; `fresh` is the best one's by games that did not choose it."""
    best, scores = best_of(attacks), _scores(attacks)
    rows = [row for each in attacks for row in _rows(each)]
    columns = [Column("seed"), Column("steps"), Column("score", "score %"), Column("interval", title="95 %")]
    columns += [Column("victim")] if len(best.views) > 1 else []
    columns += [Column(outcome, f"{outcome} %", 1) for outcome in OUTCOMES]
    median = f"{100 * statistics.median(scores):.1f} %" if scores else "-"
    return "\n".join([
        f"{len(attacks)} attackers of {best.victim}: their scores, and how often {best.victim} wins, draws and loses,"
        f" of {best.found.score.games:,} games each.",
        render(rows, columns),
        f"Median score {median}. The best, played again by games that did not choose it:",
        *_finding_lines(best.victim, best.attacker.name, fresh),
        f"All are now fixed players of league {best.pair.opened.league}.",
    ])  # fmt: skip


def as_json(made: Attacked) -> str:
    """Return the report of one attack as JSON."""
    return json.dumps(_fields(made), indent=2)


def several_as_json(attacks: Sequence[Attacked], fresh: Finding) -> str:
    """Return the report of attackers of one victim as JSON; `fresh` as in `text_of_several`."""
    best, scores = best_of(attacks), _scores(attacks)
    content = {
        "victim": best.victim, "attackers": [{"seed": each.chosen.config.seed, **_fields(each)} for each in attacks],
        "median": statistics.median(scores) if scores else None,
        "best": {"attacker": best.attacker.name, "seed": best.chosen.config.seed, **_finding_fields(fresh)},
    }  # fmt: skip
    return json.dumps(content, indent=2)


def _scores(attacks: Sequence[Attacked]) -> list[float]:
    """Return the scores of attackers with games that count."""
    return [each.found.score.score for each in attacks if each.found.score.games]


def _rows(made: Attacked) -> list[dict[str, Any]]:
    """Return an attack as rows of the table of several: one for each way in which the victim saw its opponent."""
    score = made.found.score
    about = {
        "seed": str(made.chosen.config.seed), "steps": f"{made.attacker.step:,}",
        "score": f"{100 * score.score:.1f}" if score.games else "-",
        "interval": f"{100 * score.low:.1f}-{100 * score.high:.1f}" if score.games else "-",
    }  # fmt: skip
    first, *others = (_percent(row) for row in _view_rows(made.views))
    return [{**about, **first}, *({**dict.fromkeys(about, ""), **row} for row in others)]


def _percent(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: 100 * value if isinstance(value, float) else value for key, value in row.items()}


def _view_rows(views: Views) -> list[dict[str, Any]]:
    """Return a row for each way in which the victim saw its opponent: its wins, draws and losses as shares."""
    rows = []
    for view, counts in views.items():
        games = sum(counts)
        shares = [count / games if games else None for count in counts]
        rows.append({"victim": view, "games": games, **dict(zip(OUTCOMES, shares, strict=True))})
    return rows


def _finding_lines(victim: str, attacker: str, took: Finding) -> list[str]:
    over, low, high = took.over
    if not took.score.games:
        return ["All were void."]
    lines = [f"{attacker} scores {score_text(took.score)} against {victim}."]
    interval = f"{100 * over:+.1f} % (95 % interval {100 * low:+.1f} to {100 * high:+.1f})"
    if math.isnan(over):
        lines.append(f"{victim} has met nobody else, so there is nothing to compare it with.")
    elif took.usual is not None:
        lines.append(
            f"That is {interval} more than its usual opponents, who score {score_text(took.usual)}. Sides are unlike,"
            " so the game's value is not known, nor how much of the score is due to a hole."
        )
    else:
        hole = "" if low > 0 else " No hole is shown: a best opponent scores at least ½ in any case."
        lines.append(f"Exploitability of {victim}, at least: {interval}, the score less ½.{hole}")
    return lines


def _fields(made: Attacked) -> dict[str, Any]:
    attacker, league = made.attacker, made.chosen.config.league
    return {
        "victim": made.victim, "attacker": attacker.name, "league": league, "lineage": list(made.lineage),
        "iterations": attacker.iteration, "steps": attacker.step, "seconds": attacker.seconds,
        **_finding_fields(made.found), "victim_results": _view_rows(made.views),
    }  # fmt: skip


def _finding_fields(took: Finding) -> dict[str, Any]:
    over, low, high = took.over
    found = {
        "episodes": took.score.games, "score": took.score.score, "score_low": took.score.low,
        "score_high": took.score.high, "usual": took.usual.score if took.usual else None,
        "exploitability": over if took.usual is None else None, "over_usual": over if took.usual else None,
        "low": low, "high": high,
    }  # fmt: skip
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in found.items()}
