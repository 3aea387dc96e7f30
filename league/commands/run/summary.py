"""The summary that `league run` prints at its end: comparisons of players, their certainty, and next commands."""

import shlex

from dashboards.text import clock, wrapped
from league.commands.ladder_text import ratings_table
from league.commands.options import place_flags
from league.commands.status_line import trouble_text
from league.config.experiment import Config
from league.queries.query import score_text
from league.queries.ratings.evidence import evidence_text
from league.scheduling.progress_metrics import can_meet, reference_opponents
from league.state.league_state import LeagueState
from league.state.void_rates import warnings as void_warnings
from matchmaking.ratings.comparison import compare_snapshots
from storage.database.urls import display_location
from storage.records import Snapshot

NEXT = """\
  league ratings     who is better, and how sure that is
  league watch       a recorded match in 3D (league watch --shot match.png where there is no display)
  league dash        all of it as a page, with films of matches
  league run         go on training from where it stopped"""
RIVALS = (
    3  # most newest snapshots of others whose games are listed one by one; `league payoff --newest` has more of them
)


def summary(config: Config, state: LeagueState, store: str) -> str:
    """Return the ladder, each newest snapshot's scores against its reference opponents, and the next commands."""
    table = ratings_table(state.ladder, state.snapshots, state.players, config.rating.void_limit)
    trouble = [f"{text}: `league status` tells why."] if (text := trouble_text(state)) else []
    voids = ["\n".join(wrapped(text) for text in void_warnings(state.voids))] if state.voids else []
    place = place_flags(store, config.storage.blobs)
    following = f"Next{place and f', each with {place}'}:\n{NEXT}"
    return "\n\n".join(
        [table, *_scores_of_newest(config, state), *_who_is_better(config, state, store), *trouble, *voids, following]
    )


def _who_is_better(config: Config, state: LeagueState, store: str) -> list[str]:
    """Return whether the best player's newest snapshot is stronger than the second player's, for each roster.

    Also whose strength is not known, and the command by which it will be.
    """
    newest = [s for s in state.newest_snapshots if not state.one_team]
    known = [s for s in newest if state.ladder.known(s.name)]
    lines = []
    ratings = state.ladder.ratings
    for roster in dict.fromkeys(s.roster for s in known):
        alike = sorted((s for s in known if s.roster == roster), key=lambda s: -ratings.elo[ratings.index(s.name)])
        if len(alike) < 2:
            continue
        first, second = alike[:2]
        if first.digest == second.digest:  # a copy by the ladder schedule: their ratings differ by chance alone
            lines.append(f"{first.name} and {second.name} are the same policy.")
        else:
            lines.append(wrapped(evidence_text(compare_snapshots(state.ladder, first.name, second.name))))
    unknown = [s.name for s in newest if s not in known]
    if unknown:
        told = f"Not known yet: how strong {' and '.join(unknown)} {'is' if len(unknown) == 1 else 'are'}."
        where = shlex.join(["--store", display_location(store), "--league", config.league])
        lines.append(f"{wrapped(f'{told} This plays more matches:')}\n  league rate {where} --budget 2m")
    return lines


def _scores_of_newest(config: Config, state: LeagueState) -> list[str]:
    """Return each newest snapshot's scores against its reference opponents, or in an arena of one team its success."""
    blocks = []
    for snapshot in state.newest_snapshots:
        if state.one_team:
            trial_episodes = state.ladder.trial_episodes(snapshot.name)
            said = score_text(state.ladder.success(snapshot.name)) if trial_episodes else "not tried yet"
            blocks.append(f"{snapshot.name} succeeds: {said}")
            continue
        lines, unmet = [f"{snapshot.name} against"], []
        for other in _listed_opponents(config, state, snapshot):
            score = state.ladder.score(snapshot.name, other.name)
            if score.games:
                lines.append(f"  {_title(snapshot.player, other):<34} {score_text(score)}")
            else:
                unmet.append(other.name)
        if unmet:
            lines.append(wrapped(f"  not yet against {', '.join(unmet)}"))
        if len(lines) > 1:
            blocks.append("\n".join(lines))
    return blocks


def _listed_opponents(config: Config, state: LeagueState, snapshot: Snapshot) -> list[Snapshot]:
    """Return the other players' newest snapshots that it can meet, if they are few, and its reference opponents."""
    others = [s for s in state.newest_snapshots if s.player != snapshot.player]
    rivals = [s for s in others if can_meet(snapshot, s, state.players)]
    rivals = rivals if len(rivals) <= RIVALS else []
    return list({s.name: s for s in (*rivals, *reference_opponents(config, state, snapshot))}.values())


def _title(player: str | None, other: Snapshot) -> str:
    if other.script:
        return other.name
    own = "its own " if other.player == player else ""
    return f"{own}{other.name} ({clock(other.seconds)} of training)"
