"""Model card: the data of a frozen policy in the store as a page. All its content comes from the store."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from dashboards.text import clock
from league.queries.query import Open, score_text
from league.snapshots.policy_file import rating_row
from matchmaking.ratings.ladder import ANCHOR_ELO, UNKNOWN, Ladder
from storage.records import Snapshot


def card(league: Open, about: Mapping[str, Any], file: str, rated: Sequence[Ladder]) -> str:
    """Return the card of an exported policy, as Markdown; it is a snapshot that has played on the ladders `rated`."""
    parts = [f"# {about['name']} of league {league.league}", _facts(about, file)]
    for ladder in rated:
        parts += _rated(league, ladder, league.snapshot(about["name"]))
    if about["rating"] is None:
        parts.append("It has played no rating match.")
    return "\n\n".join(parts) + "\n"


def _facts(about: Mapping[str, Any], file: str) -> str:
    arena, spent = about["arena"], clock(about["seconds"])
    rows = [
        ("file", f"`{file}`: safetensors; parameters are named `<agent>/<parameter>`"),
        ("policy", f"SHA-256 `{about['digest']}`"),
        ("player", about["player"] or f"none ({about['origin']})"),
        ("roster", f"`{about['roster']}`"),
        *((f"agent {i}", _network(agent)) for i, agent in enumerate(about["agents"])),
        (
            "learnt in",
            f"{arena['arena']} under {arena['engine']}, rules `{arena['config_hash']}`" if arena else "nothing",
        ),
        ("trained", f"{about['iteration']:,} iterations, {about['steps']:,} steps (decisions × worlds), {spent}"),
        ("goes on from", ", ".join(about["parents"]) or "nothing"),
        ("versions", ", ".join(f"{name} {version}" for name, version in about["versions"].items()) or "not known"),
        ("settings", "in the file's metadata, `robot_league`, as TOML"),
    ]
    return "\n".join(["| | |", "|---|---|", *(f"| {name} | {_cell(text)} |" for name, text in rows)])


def _network(agent: Mapping[str, Any]) -> str:
    layers, norm = ", ".join(map(str, agent["hidden"])), " with LayerNorm" if agent["layer_norm"] else ""
    limit, by_state = agent["squash"], ", deviation by state" if agent["state_std"] else ""
    gru = f", then a GRU of {agent['recurrent']} units" if agent.get("recurrent") else ""
    squashed = "" if limit is None else f", actions squashed to ±{limit:g}"
    if over := agent.get("over"):
        count, every = len(over["skills"]), over["every"]
        skills = f"{count} skill{'' if count == 1 else 's'}" if count else "no skill"
        squashed += f"; it commands {skills} with {over['choices']} numbers every {every} decisions"
    return (
        f"{agent['kind']}: sees {agent['observation']} numbers, acts with {agent['action']}; hidden layers {layers},"
        f" {agent['activation']}{norm}{gru}{by_state}{squashed}"
    )


def _rated(league: Open, ladder: Ladder, snapshot: Snapshot) -> Iterator[str]:
    """Yield blocks of text: the rating of a snapshot on a ladder, and scores against fixed opponents."""
    key, row = ladder.arena, rating_row(league, ladder, snapshot)
    assert key is not None  # because the snapshot has played
    yield f"## In {key.arena} under {key.engine}, rules `{key.config_hash}`"
    voids = f" Void: {100 * row['voids_own']:.2g} % by its own robots, {100 * row['voids_unclear']:.2g} % unclear."
    voids = voids if row["voids_own"] or row["voids_unclear"] else " None of its episodes was void."
    if ladder.one_team:
        yield f"It succeeds: {score_text(ladder.success(snapshot.name))} episodes, with the 95 % interval.{voids}"
        return
    elo = f"{row['elo']:.0f} Elo (95 %: {row['low']:.0f} to {row['high']:.0f})"
    elo = elo if row["known"] else f"Not yet known (an interval wider than {UNKNOWN:.0f} Elo)"
    anchor = f"the mean of the initial snapshots is {ANCHOR_ELO:.0f}"
    yield f"{elo} after {row['games']:,} episodes; {anchor}.{voids}"
    scores = [
        (title, score_text(score))
        for title, other in _fixed(league, snapshot)
        if (score := ladder.score(snapshot.name, other)).games
    ]
    if scores:
        head = ["| against | score, draws half, with its 95 % interval, of episodes |", "|---|---|"]
        yield "\n".join([*head, *(f"| {_cell(title)} | {text} |" for title, text in scores)])


def _fixed(league: Open, snapshot: Snapshot) -> Iterator[tuple[str, str]]:
    """Yield title and name of the opponents that measure progress: scripts, imported policies, initial snapshots."""
    for other in league.store.snapshots(league.league):
        kind = "script" if other.script else "imported" if other.origin == "imported" else "initial"
        if other.name != snapshot.name and (kind != "initial" or other.initial):
            yield f"{other.name} ({kind})", other.name


def _cell(text: str) -> str:
    """Escape text for a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("\n", " ")
