"""Frozen policies as files: safetensors with the networks' own parameter names, and metadata.

Arrays are named `<agent>/<parameter>`, as in a snapshot's bytes: `0/trunk.hidden.0.weight` is of the roster's first
agent. The header's metadata has one entry, `robot_league`, with the JSON that `about` returns. It is a single entry,
because safetensors writes several in no fixed order, and equal policies must give equal files.
"""

import hashlib
import json
import math
import struct
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors.numpy import save

from agents.policy.skill_arrays import PREFIX
from arenas import rosters
from league.config.schema import ConfigError
from league.queries.query import Open
from league.queries.ratings.rating_rows import Row, rating_rows
from league.snapshots.exports.networks import agents_of
from league.snapshots.programs.kinds import SUFFIXES
from league.system.provenance import code_of
from matchmaking.ratings.ladder import Ladder
from storage.blobs import arrays, programs
from storage.blobs.files import open_file as opened_file
from storage.errors import StorageError, UnknownName
from storage.maintenance.archive import shortened
from storage.records import ArenaKey, Snapshot

FORMAT = 1
KEY = "robot_league"
TRAINED = Path(__file__).parents[1] / "trained"
"""Folder of the policies that come with the league, and of their cards."""
LIMIT = 2**30  # bytes of a file
TEXT_LIMIT = 4096  # letters of a name or a roster


class ExchangeError(StorageError):
    """A file has no frozen policy that this program can read, or none for this league; nothing was written."""


class Policy(NamedTuple):
    """The content of a policy file."""

    arrays: Mapping[str, np.ndarray]
    about: Mapping[str, Any]  # see `about`

    def to_bytes(self) -> bytes:
        """Return the bytes of the file."""
        ordered = {name: np.asarray(self.arrays[name], order="C") for name in sorted(self.arrays)}
        return save(ordered, metadata={KEY: json.dumps(self.about, sort_keys=True, allow_nan=False)})


def export(league: Open, name: str, rated: Sequence[Ladder] | None = None) -> Policy:
    """Return a snapshot of a league with its metadata. Raises UnknownName, StorageError (a script, damage).

    `rated`, the ladders on which it has played, saves reading if the caller has them already.
    """
    snapshot = league.snapshot(name)
    if snapshot.script is not None:
        raise StorageError(f"{name} is a script, which has no weights to export; every league of its arena has it.")
    data = league.store.blobs.get(snapshot.digest)
    if programs.is_program(data):
        kind = programs.from_bytes(data)[1].get("kind")
        raise StorageError(f"{name} is a program ({kind}) and no network: `league export {name} -o FILE` writes it.")
    found = arrays.from_bytes(data)
    try:
        agents = agents_of(found, snapshot.roster)
    except ValueError as error:
        raise StorageError(f"{name} is of a network that this version cannot export: {shortened(error)}.") from None
    return Policy(found, about(league, snapshot, agents, ladders(league, snapshot) if rated is None else rated))


def export_checkpoint(league: Open, player: str) -> Policy | None:
    """Return a player as its newest checkpoint has it; None if it has not learnt on since its newest snapshot.

    Raises UnknownName for a name that is no player's, StorageError for a learner of a user's, whose checkpoint is its
    own, and for damage.
    """
    from agents.learner.checkpoint import actors  # loads torch

    store, players = league.store, {p.name: p for p in league.store.players(league.league)}
    if player not in players:
        raise UnknownName("player", player, [*players])
    newest, done = league.snapshot(player), store.newest_checkpoints(league.league).get(player)
    if done is None or newest.iteration == done.iteration:
        return None
    state, roster = arrays.from_bytes(store.blobs.get(done.digest)), players[player].roster
    try:
        policies = actors(state, len(rosters.roster_agents(roster)))
        found = {f"{i}/{name}": array for i, policy in enumerate(policies) for name, array in policy.items()}
        found |= {k.removeprefix(PREFIX): array for k, array in state.items() if k.startswith(PREFIX)}  # its skills
        agents = agents_of(found, roster)
    except ValueError as error:
        raise StorageError(
            f"the checkpoint of {player} is of a learner that this version cannot export ({shortened(error)}): take its"
            f" newest snapshot, {newest.name}"
        ) from None
    snapshot = replace(
        newest, name=f"{player}@{done.iteration}", digest=hashlib.sha256(arrays.to_bytes(found)).hexdigest(),
        parent=newest.name, initial=False, arena=done.arena, step=done.step, iteration=done.iteration,
        seconds=done.seconds, created=done.created,
    )  # fmt: skip
    return Policy(found, about(league, snapshot, agents, []))


def about(
    league: Open, snapshot: Snapshot, agents: list[dict[str, Any]], rated: Sequence[Ladder]
) -> dict[str, Any]:  # fmt: skip
    """Return a snapshot's metadata as JSON: player, roster, networks, arena, settings, training and rating."""
    return {
        "format": FORMAT, "league": league.league, "name": snapshot.name, "digest": snapshot.digest,
        "player": snapshot.player, "origin": snapshot.origin, "roster": snapshot.roster, "agents": agents,
        "arena": snapshot.arena._asdict() if snapshot.arena else None, "settings": snapshot.settings,
        "parents": _parents(league, snapshot), "iteration": snapshot.iteration, "steps": snapshot.step,
        "seconds": snapshot.seconds, "versions": _versions(league, snapshot), "created": snapshot.created,
        "rating": _rating(league, snapshot, rated),
    }  # fmt: skip


def ladders(league: Open, snapshot: Snapshot) -> list[Ladder]:
    """Return the ladders on which a snapshot has played, the one with the newest matches first."""
    found = league.shown(all=True).ladders
    return [each for each in found if each.payoff.played[each.payoff.index(snapshot.name)] or _tried(each, snapshot)]


def rating_row(league: Open, ladder: Ladder, snapshot: Snapshot) -> Row:
    """Return the row of a snapshot on that ladder, as in `league ratings`."""
    snapshots, players = league.store.snapshots(league.league), league.store.players(league.league)
    return next(r for r in rating_rows(ladder, snapshots, players, league.void_limit()) if r["name"] == snapshot.name)


def _rating(league: Open, snapshot: Snapshot, rated: Sequence[Ladder]) -> dict[str, Any] | None:
    for ladder in rated[:1]:
        row = rating_row(league, ladder, snapshot)
        about = {name: row[name] for name in ArenaKey._fields} | {"episodes": row["games"]}
        if ladder.one_team:
            return about | {name: row[name] for name in ("success", "success_low", "success_high")}
        return about | {name: row[name] for name in ("elo", "low", "high", "known")} | {"score": row["win_rate"]}
    return None


def _tried(ladder: Ladder, snapshot: Snapshot) -> bool:
    return bool(ladder.trial_episodes(snapshot.name))


def _parents(league: Open, snapshot: Snapshot) -> list[str]:
    """Return the ancestors of a snapshot, the nearest first; the last may be of another league."""
    snapshots = {s.name: s for s in league.store.snapshots(league.league)}
    found: list[str] = []
    while snapshot.parent is not None and snapshot.parent not in found:
        found.append(snapshot.parent)
        if snapshot.parent not in snapshots:
            break
        snapshot = snapshots[snapshot.parent]
    return found


def _versions(league: Open, snapshot: Snapshot) -> dict[str, str]:
    """Return the versions of the run that made a snapshot; the store does not know those of an imported one."""
    runs = [run for run in league.store.runs(league.league) if run.started <= snapshot.created]
    found = dict(runs[-1].versions) if runs and snapshot.origin == "trained" else {}
    if (own := code_of(snapshot.settings)) not in (None, found.get("code")):  # made by a worker with other code
        found.pop("commit", None)
    return {**found, "code": own} if own else found


# Reading -------------------------------------------------------------------------------------------------------------


def trained() -> list[str]:
    """Return the names of the policies that come with the league."""
    return sorted(path.stem for path in TRAINED.glob("*.safetensors"))


def find(named: str) -> Path:
    """Return the file of a policy that comes with the league, else the file of that name. Raises UnknownName."""
    if named in trained():
        return TRAINED / f"{named}.safetensors"
    path = Path(named)
    if not path.exists() and not path.suffix and path.name == named:
        raise UnknownName("file or trained policy", named, trained())
    return path


def read(path: Path) -> Policy:
    """Read and check the policy in a file. Raises ExchangeError, one line, for a file without a valid policy."""
    with opened_file(path) as file:
        data = file.read(LIMIT + 1)
    if path.suffix == ".py":
        raise ExchangeError(f"{path} is a Python file: name its function or class too, {path}:function.")
    if path.suffix.lower() in SUFFIXES:
        raise ExchangeError(f"{path} is a program, which is no network of `league export`: give its x.safetensors.")
    if len(data) > LIMIT:
        raise ExchangeError(f"{path} has more than {LIMIT:,} bytes, which no policy has.")
    try:
        found = arrays.from_bytes(data)
    except StorageError as error:
        others = "nor is its name that of a program (x.onnx, x.pt, x.py:function)"
        raise ExchangeError(f"{path} is no policy that `league export` wrote, {others}: {shortened(error)}") from None
    try:
        about = json.loads(_metadata(data)[KEY])
    except (KeyError, ValueError, TypeError, RecursionError, struct.error):
        raise ExchangeError(f"{path} was not written by `league export`: it does not tell of a {KEY}.") from None
    try:
        agents = _examine(found, about)
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        raise ExchangeError(f"{path} is damaged: {shortened(error)}.") from None
    return Policy(found, {**about, "agents": agents})


def _metadata(data: bytes) -> Mapping[str, str]:
    (size,) = struct.unpack("<Q", data[:8])
    return json.loads(data[8 : 8 + size])["__metadata__"]


def _examine(found: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Check that arrays and metadata are of one policy, and describe its agents' networks by the arrays alone.

    Raises ValueError, or ExchangeError for a newer format.
    """
    if not isinstance(about, dict):
        raise ValueError("what it tells of itself is no object")
    number = about["format"]
    if isinstance(number, bool) or not isinstance(number, int):
        raise ValueError("its format is no number")
    if number > FORMAT:
        raise ExchangeError(f"It has format {number}, but this program knows only up to {FORMAT}: update robot-league.")
    for key in ("league", "name", "roster", "settings"):
        lines = about[key].splitlines() if isinstance(about[key], str) else ["\0"]
        short = key == "settings" or (len(lines) <= 1 and len(about[key]) <= TEXT_LIMIT)
        if not short or not all(line.isprintable() for line in lines):
            raise ValueError(f"its {key} is no text")
        about[key].encode()
    for key, limit in (("iteration", 2**63), ("steps", 2**63), ("seconds", math.inf)):
        kind = (int, float) if key == "seconds" else int
        if isinstance(about[key], bool) or not isinstance(about[key], kind) or not 0 <= about[key] < limit:
            raise ValueError(f"its {key} are no number")
    arena = about["arena"]
    if arena is not None:
        if not isinstance(arena, dict) or arena.keys() != set(ArenaKey._fields):
            raise ValueError("its arena is not given by name, configuration hash and engine")
        if not all(isinstance(value, str) and value.isprintable() for value in arena.values()):
            raise ValueError("its arena is not given as text")
    agents = agents_of(found, about["roster"])
    if hashlib.sha256(arrays.to_bytes(found)).hexdigest() != about["digest"]:
        raise ValueError("its parameters are not those that were exported")
    return agents


# Importing -----------------------------------------------------------------------------------------------------------


def bring_in(league: Open, policy: Policy, name: str) -> Snapshot:
    """Add a policy to a league as a snapshot that belongs to no player and never learns.

    Raises ExchangeError if no side of the league has its roster, ConfigError if the name is taken.
    """
    store, about = league.store, policy.about
    players = store.players(league.league)
    roster = rosters.matching_roster(about["roster"], (p.roster for p in players))
    if roster is None:
        known = " and ".join(dict.fromkeys(f"{p.roster} (team {p.team})" for p in players)) or "no players yet"
        raise ExchangeError(
            f"The policy is for {shortened(about['roster'])}, and league {league.league!r}{_arena(league)} has {known}."
        )
    digest = hashlib.sha256(arrays.to_bytes(policy.arrays)).hexdigest()
    taken = {s.name: s for s in store.snapshots(league.league)}
    if name in {p.name for p in players} or (name in taken and taken[name].digest != digest):
        raise ConfigError(("as",), f"--as {name}: league {league.league} has a player or snapshot of that name already")
    arena = None if about["arena"] is None else ArenaKey(**about["arena"])
    snapshot = Snapshot(
        league.league, name, store.blobs.put(arrays.to_bytes(policy.arrays)), roster, origin="imported",
        parent=f"{about['league']}/{about['name']}", arena=arena, settings=about["settings"], step=about["steps"],
        iteration=about["iteration"], seconds=float(about["seconds"]),
    )  # fmt: skip
    store.add_snapshots([snapshot])
    return next(s for s in store.snapshots(league.league) if s.name == name)


def _arena(league: Open) -> str:
    """Return the arena of a league in words; empty if not known."""
    name = arena_name(league)
    return f" in {name}" if name else ""


def arena_name(league: Open) -> str:
    """Return the name of the arena in a league's settings; empty if they have none."""
    try:
        return str(tomllib.loads(league.store.league(league.league).config)["arena"]["name"])
    except (ValueError, RecursionError, KeyError, TypeError):
        return ""
