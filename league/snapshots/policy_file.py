"""Frozen policies as files: safetensors with the networks' own parameter names, and metadata.

Arrays are named `<agent>/<parameter>`, as in a snapshot's bytes: `0/trunk.hidden.0.weight` is of the roster's first
agent. The header's metadata has one entry, `robot_league`, with the JSON that `about` returns. It is a single entry,
because safetensors writes several in no fixed order, and equal policies must give equal files.
"""

import hashlib
import json
import math
import re
import struct
import tomllib
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from safetensors.numpy import save

from agents.settings import ACTIVATIONS
from arenas import rosters
from league.config.schema import ConfigError
from league.queries.query import Open
from league.queries.ratings.rating_rows import Row, rating_rows
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


def export(league: Open, name: str) -> Policy:
    """Return a snapshot of a league with its metadata. Raises UnknownName, StorageError (a script, damage)."""
    snapshot = league.snapshot(name)
    if snapshot.script is not None:
        raise StorageError(f"{name} is a script, which has no weights to export; every league of its arena has it.")
    data = league.store.blobs.get(snapshot.digest)
    if programs.is_program(data):
        files, about_it = programs.from_bytes(data)
        raise StorageError(f"{name} is a program, {shortened(files[0][0])} ({about_it.get('kind')}): take that file.")
    found = arrays.from_bytes(data)
    try:
        agents = agents_of(found, snapshot.roster)
    except ValueError as error:
        raise StorageError(f"{name} is of a network that this version cannot export: {shortened(error)}.") from None
    return Policy(found, about(league, snapshot, agents))


def about(league: Open, snapshot: Snapshot, agents: list[dict[str, Any]]) -> dict[str, Any]:
    """Return a snapshot's metadata as JSON: player, roster, networks, arena, settings, training and rating."""
    return {
        "format": FORMAT, "league": league.league, "name": snapshot.name, "digest": snapshot.digest,
        "player": snapshot.player, "origin": snapshot.origin, "roster": snapshot.roster, "agents": agents,
        "arena": snapshot.arena._asdict() if snapshot.arena else None, "settings": snapshot.settings,
        "parents": _parents(league, snapshot), "iteration": snapshot.iteration, "steps": snapshot.step,
        "seconds": snapshot.seconds, "versions": _versions(league, snapshot), "created": snapshot.created,
        "rating": _rating(league, snapshot),
    }  # fmt: skip


def ladders(league: Open, snapshot: Snapshot) -> list[Ladder]:
    """Return the ladders on which a snapshot has played, the one with the newest matches first."""
    found = map(league.ladder, league.ladders())
    return [each for each in found if each.payoff.played[each.payoff.index(snapshot.name)] or _tried(each, snapshot)]


def rating_row(league: Open, ladder: Ladder, snapshot: Snapshot) -> Row:
    """Return the row of a snapshot on that ladder, as in `league ratings`."""
    snapshots, players = league.store.snapshots(league.league), league.store.players(league.league)
    return next(r for r in rating_rows(ladder, snapshots, players, league.void_limit()) if r["name"] == snapshot.name)


def _rating(league: Open, snapshot: Snapshot) -> dict[str, Any] | None:
    for ladder in ladders(league, snapshot)[:1]:
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
        _examine(found, about)
    except (ValueError, TypeError, LookupError, OverflowError) as error:
        raise ExchangeError(f"{path} is damaged: {shortened(error)}.") from None
    return Policy(found, about)


def _metadata(data: bytes) -> Mapping[str, str]:
    (size,) = struct.unpack("<Q", data[:8])
    return json.loads(data[8 : 8 + size])["__metadata__"]


def _examine(found: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
    """Check that arrays and metadata are of one policy. Raises ValueError, or ExchangeError for a newer format."""
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
    agents_of(found, about["roster"])
    if hashlib.sha256(arrays.to_bytes(found)).hexdigest() != about["digest"]:
        raise ValueError("its parameters are not those that were exported")


def agents_of(found: Mapping[str, np.ndarray], roster: str) -> list[dict[str, Any]]:
    """Describe each agent's network, in the roster's order. Raises ValueError if the arrays do not fit a network."""
    agents, used = [], set()
    for number, agent in enumerate(rosters.roster_agents(roster)):
        if not (match := re.fullmatch(r"([^:+]+):(\d{1,9}):(\d{1,9})", agent)):
            raise ValueError(f"{agent!r} is no agent's kind with the sizes of its observation and action")
        kind, sees, acts = match[1], int(match[2]), int(match[3])
        own = {k.removeprefix(f"{number}/"): v for k, v in found.items() if k.startswith(f"{number}/")}
        used |= {f"{number}/{name}" for name in own}
        hidden = []
        while (weight := own.get(f"trunk.hidden.{len(hidden)}.weight")) is not None and weight.ndim == 2:
            hidden.append(weight.shape[0])
        normed = "trunk.norm.0.weight" in own
        kinds = "deviation.weight" in own, "squash" in own
        gru = own.get("gru.weight_hh")
        units = gru.shape[-1] if gru is not None and gru.ndim == 2 else 0
        sets = _entity_sets(own, sees)
        wanted = _shapes(sees, acts, hidden, normed, *kinds, units, sets)
        for name in sorted(own.keys() ^ wanted.keys()):
            raise ValueError(f"agent {number} has {'an unknown' if name in own else 'no'} parameter {name}")
        for name, shape in wanted.items():
            if own[name].shape != shape:
                raise ValueError(f"agent {number}'s {name} has the shape {own[name].shape}, and {kind} needs {shape}")
            whole = name == "activation" or name.endswith((".index", ".own"))
            if own[name].dtype != (np.int32 if whole else np.float32):
                raise ValueError(f"agent {number}'s {name} is of type {own[name].dtype}")
            if not np.isfinite(own[name]).all():
                raise ValueError(f"agent {number}'s {name} is not finite")
        activation = int(own["activation"])
        if not 0 <= activation < len(ACTIVATIONS):
            raise ValueError(f"agent {number} has activation {activation}, which is none")
        agents.append({
            "kind": kind, "observation": sees, "action": acts, "hidden": hidden,
            "activation": ACTIVATIONS[activation], "layer_norm": normed, "state_std": kinds[0],
            "squash": float(own["squash"]) if kinds[1] else None,
        } | ({"recurrent": units} if units else {}) | ({"entities": sets} if sets else {}))  # fmt: skip
    if unknown := sorted(found.keys() - used):
        raise ValueError(f"{unknown[0]} is a parameter of no agent of {roster}")
    return agents


def _entity_sets(own: Mapping[str, np.ndarray], sees: int) -> list[list[int]]:
    """Return entities, numbers of each, and the encoder's width of each set (agents/policy/entities.py).

    Raises ValueError unless each of the `sees` places is in one entity or the agent's own.
    """
    found: list[list[int]] = []
    places = [np.asarray(own.get("trunk.own", np.zeros(0, np.int32))).reshape(-1)]
    while (index := own.get(f"trunk.entities.{len(found)}.index")) is not None:
        weight = own.get(f"trunk.entities.{len(found)}.layers.0.weight")
        if index.ndim != 2 or weight is None or weight.ndim != 2:
            raise ValueError(f"entities {len(found)} are no set with an encoder")
        found.append([*index.shape, weight.shape[0]])
        places.append(index.reshape(-1))
    if found and not np.array_equal(np.sort(np.concatenate(places)), np.arange(sees)):
        raise ValueError("its entities and own numbers are not those of its observation")
    return found


def _shapes(
    sees: int, acts: int, hidden: list[int], normed: bool, state_std: bool, squashed: bool, units: int,
    sets: list[list[int]],
) -> dict[str, tuple[int, ...]]:  # fmt: skip
    """Return shapes of an actor's parameters (agents/policy/networks.py) by name; `units` of its GRU, 0 without one."""
    own = sees - sum(count * size for count, size, _ in sets)
    widths = [own + 2 * sum(width for *_, width in sets), *hidden]
    last = units or widths[-1]
    shapes: dict[str, tuple[int, ...]] = {
        "activation": (), "std_scale": (),
        "mean.bias": (acts,), "mean.weight": (acts, last),
        "trunk.observation_mean": (sees,), "trunk.observation_var": (sees,), "trunk.observation_clip": (),
    }  # fmt: skip
    shapes |= {"trunk.own": (own,)} if sets else {}
    for i, (count, size, width) in enumerate(sets):
        of_set = {"index": (count, size), "layers.0.weight": (width, size), "layers.1.weight": (width, width)}
        of_set |= {"layers.0.bias": (width,), "layers.1.bias": (width,)}
        shapes |= {f"trunk.entities.{i}.{name}": shape for name, shape in of_set.items()}
    deviation = {"deviation.bias": (acts,), "deviation.weight": (acts, last)}
    shapes |= deviation if state_std else {"std_logit": (acts,)}
    shapes |= {"squash": ()} if squashed else {}
    if units:
        shapes |= {f"gru.bias_{of}": (3 * units,) for of in ("ih", "hh")}
        shapes |= {"gru.weight_ih": (3 * units, widths[-1]), "gru.weight_hh": (3 * units, units)}
        shapes |= {"gru.norm.weight": (units,), "gru.norm.bias": (units,)} if normed else {}
    for i, (before, after) in enumerate(pairwise(widths)):
        shapes |= {f"trunk.hidden.{i}.weight": (after, before), f"trunk.hidden.{i}.bias": (after,)}
    for i, width in enumerate(widths if normed else ()):
        shapes |= {f"trunk.norm.{i}.weight": (width,), f"trunk.norm.{i}.bias": (width,)}
    return shapes


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


def bring_in_trained(league: Open, arena: str) -> None:
    """Add the policies that come with the league and learnt in this arena, if they fit and their name is free."""
    players = league.store.players(league.league)
    taken = {p.name for p in players} | {s.name for s in league.store.snapshots(league.league)}
    for name in trained():
        policy = read(find(name))
        learnt_here = (policy.about["arena"] or {}).get("arena") == arena
        if (
            learnt_here
            and name not in taken
            and rosters.matching_roster(policy.about["roster"], (p.roster for p in players))
        ):
            bring_in(league, policy, name)


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
