"""Recordings of matches: one episode or several of a match as one MCAP file that can be replayed without the store.

The file holds the recorded data and no pictures: joint positions, actions, rewards and their named terms, score,
markers and events, with the compiled MJCF attached. GPU physics is not bit-reproducible, so a replay uses these
recorded states, never the seed.

    profile     league
    metadata    league.match: the header, each value as JSON, and the number of steps
    attachment  arena.xml
    /match/step   league.v1.Step, one per control step, sequence = step, log time = step × dt
    /match/event  league.v1.Event, after the step in which it happened

A second episode is in league.match.1, /match/1/step and /match/1/event, a third in league.match.2, and so on. The same
content gives the same bytes, and a checksum covers every byte. Messages are in chunks of 64 KiB, each of which can be
read if others are damaged: `storage.recordings.salvage`.
"""

import dataclasses
import io
import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from storage.errors import StorageError
from storage.recordings import mcap_messages
from storage.records import ArenaKey

FORMAT = 1
CHUNK = 64 * 1024  # bytes lost by one damaged place, about 150 steps
MAGIC = b"\x89MCAP0\r\n"


class RecordingError(StorageError):
    """The bytes are not a whole, undamaged recording of a match."""


@dataclass(frozen=True)
class RecordingHeader:
    """The players and the outcome of an episode. Tuples with one entry per side are in the arena's team order."""

    league: str
    match: int  # 0: the number is not known yet, since a match is stored after its recording
    seed: int
    world: int  # index of the world in the match's batch
    arena: ArenaKey
    sides: tuple[str, ...]  # snapshot names, e.g. ("blue@16", "red@8")
    digests: tuple[str, ...]  # of the same snapshots
    teams: tuple[str, ...]  # e.g. ("blue", "red")
    agents: tuple[tuple[str, ...], ...]  # per team, e.g. (("blue/0",), ("red/0",))
    score: tuple[float, ...]
    outcome: str  # e.g. "win blue"
    dt: float  # control interval, s
    marker_kinds: Mapping[str, str] = field(default_factory=dict)  # e.g. {"ring": "circle"}
    versions: Mapping[str, str] = field(default_factory=dict)
    created: float = 0.0  # s since the epoch


@dataclass(frozen=True, eq=False)
class Recording:
    """One episode of T control steps. Arrays of any float type are stored as float64, without loss.

    Raises ValueError where the shapes or names do not fit the header or each other.
    """

    header: RecordingHeader
    xml: str  # compiled MJCF
    time: np.ndarray  # (T,) s
    qpos: np.ndarray  # (T, nq)
    actions: Mapping[str, np.ndarray]  # agent -> (T, act)
    reward: np.ndarray  # (T, teams)
    score: np.ndarray  # (T, teams)
    markers: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (T, m), e.g. a circle's x, y, radius in m
    events: Sequence[tuple[int, str]] = ()  # (step, text)
    terms: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (T, teams), the terms of the reward
    # team or agent -> (T,), its critic's value estimate of the state where the action was chosen, in units of reward;
    # absent for teams and agents without a critic
    values: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("time", "qpos", "reward", "score"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        for name in ("actions", "markers", "terms", "values"):
            arrays = {key: np.asarray(value, np.float64) for key, value in getattr(self, name).items()}
            object.__setattr__(self, name, arrays)
        object.__setattr__(self, "events", tuple((int(step), str(text)) for step, text in self.events))
        _check(self)

    @property
    def steps(self) -> int:
        """T, the number of control steps."""
        return len(self.time)


def to_bytes(*episodes: Recording) -> bytes:
    """Return the episodes of one match, all in the same arena, as an MCAP file."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=CHUNK, enable_data_crcs=True)
    writer.start(profile="league", library="robot-league")
    for number, recording in enumerate(episodes):
        writer.add_metadata(metadata_name(number), _header_to_text(recording.header, recording.steps))
    writer.add_attachment(0, 0, "arena.xml", "application/xml", episodes[0].xml.encode())
    for number, recording in enumerate(episodes):
        if recording.xml != episodes[0].xml:
            raise ValueError(f"episode {number} was played in another arena than the first one")
        _write(writer, recording, topics(number))
    writer.finish()
    return out.getvalue()


def from_bytes(data: bytes, episode: int = 0) -> Recording:
    """Read the output of `to_bytes`. Raises RecordingError if the bytes are damaged, cut short or something else."""
    _check_crcs(data)
    records = StreamReader(io.BytesIO(data), record_size_limit=len(data)).records
    try:
        return read_episode(records, episode)[0]
    except RecordingError:
        raise
    except Exception as error:  # the bytes are undamaged, so another program or version wrote them
        raise RecordingError(f"not a match recording of format {FORMAT}: {error!r}") from error


def headers(data: bytes) -> list[RecordingHeader]:
    """Return the header of each episode, unchecked, without reading the rest. Raises RecordingError if none."""
    found: list[RecordingHeader] = []
    try:
        for record in StreamReader(io.BytesIO(data), record_size_limit=len(data), emit_chunks=True).records:
            if isinstance(record, Metadata) and record.name == metadata_name(len(found)):
                found.append(_header_from_text(record.metadata)[0])
            elif isinstance(record, Attachment):
                return found
    except Exception as error:  # as in `from_bytes`
        raise RecordingError(f"not a match recording of format {FORMAT}: {error!r}") from error
    raise RecordingError("not a match recording: no arena is attached")


def read_episode(records: Iterable[Any], episode: int) -> tuple[Recording, np.ndarray, int | None]:
    """Read an episode from MCAP records; return the recording, its step numbers, and the total steps if stated.

    Raises RecordingError if there is no such episode, ValueError if the records are not a recording.
    """
    header, count, xml = None, None, ""
    steps: list[Message] = []
    events: list[Message] = []
    kinds = dict(zip(topics(episode), (steps, events), strict=True))
    known = {2 * episode + 1: steps, 2 * episode + 2: events}  # as `to_bytes` numbers them, before a file says so
    for record in records:
        if isinstance(record, Metadata) and record.name == metadata_name(episode):
            header, count = _header_from_text(record.metadata)
        elif isinstance(record, Attachment) and record.name == "arena.xml":
            xml = record.data.decode()
        elif isinstance(record, Channel):
            known[record.id] = kinds.get(record.topic, [])
        elif isinstance(record, Message):
            known.get(record.channel_id, []).append(record)
    if header is None or not steps:
        raise RecordingError(f"the recording has no episode {episode}, or nothing of it is left")
    happened = [mcap_messages.message_classes()["Event"].FromString(event.data) for event in events]
    at = np.array([step.sequence for step in steps])
    placed = [(int(np.searchsorted(at, event.step).clip(0, len(at) - 1)), event.text) for event in happened]
    return _assembled(header, xml, mcap_messages.unpack([step.data for step in steps]), placed), at, count


def step_messages(recording: Recording) -> list[bytes]:
    """Return the league.v1.Step messages, one for each control step."""
    return mcap_messages.pack(list(_columns(recording)))


def metadata_name(episode: int) -> str:
    """Return the name of the metadata record with an episode's header."""
    return f"league.match.{episode}" if episode else "league.match"


def topics(episode: int) -> tuple[str, str]:
    """Return the topics of an episode's steps and of its events."""
    where = f"/match/{episode}" if episode else "/match"
    return f"{where}/step", f"{where}/event"


def _assembled(
    header: RecordingHeader, xml: str, columns: Sequence[mcap_messages.Column], events: Sequence[tuple[int, str]]
) -> Recording:
    found: dict[str, Any] = {"actions": {}, "markers": {}, "terms": {}, "values": {}}
    for field_name, name, numbers in columns:
        if field_name == "values":
            found[field_name][name] = numbers[:, 0]
        elif field_name in found and isinstance(found[field_name], dict):
            found[field_name][name] = numbers
        else:
            found[field_name] = numbers
    return Recording(header, xml, **found | {"time": found["time"][:, 0]}, events=events)


def _write(writer: Writer, recording: Recording, where: tuple[str, str]) -> None:
    """Write steps in their order, each followed by its events."""
    classes, dt = mcap_messages.message_classes(), recording.header.dt
    step_channel, event_channel = (
        writer.register_channel(topic, "protobuf", register_schema(writer, classes[kind]))
        for topic, kind in zip(where, ("Step", "Event"), strict=True)
    )
    events: dict[int, list[str]] = {}
    for step, text in recording.events:
        events.setdefault(step, []).append(text)
    for step, message in enumerate(step_messages(recording)):
        at = round(step * dt * 1e9)  # ns
        writer.add_message(step_channel, at, message, at, sequence=step)
        for text in events.get(step, ()):
            writer.add_message(event_channel, at, mcap_messages.event(step, text), at, sequence=step)


def _columns(recording: Recording) -> Iterator[mcap_messages.Column]:
    """Yield columns in the schema's order, then by name: the order of a dict does not change the file's digest."""
    yield "time", "", recording.time[:, None]
    for what in ("qpos", "actions", "reward", "score", "markers", "terms"):
        values = getattr(recording, what)
        named = sorted(values.items()) if isinstance(values, Mapping) else [("", values)]
        yield from ((what, name, array) for name, array in named)
    yield from (("values", who, values[:, None]) for who, values in sorted(recording.values.items()))


def _check(recording: Recording) -> None:
    header, T = recording.header, len(recording.time)
    agents = [agent for team in header.agents for agent in team]
    if T == 0:
        raise ValueError("a recording needs at least one step, got none")
    for what, given, expected in (
        ("actions", recording.actions, agents),
        ("markers", recording.markers, header.marker_kinds),
    ):
        if set(given) != set(expected):
            raise ValueError(f"{what} of {sorted(given)}, but the header names {sorted(expected)}")
    for what in ("sides", "digests", "agents", "score"):
        if len(getattr(header, what)) != len(header.teams):
            raise ValueError(f"header.{what} has {len(getattr(header, what))} entries for {len(header.teams)} teams")
    if strangers := recording.values.keys() - {*header.teams, *agents}:
        raise ValueError(f"values of {sorted(strangers)}, but the header names {[*header.teams, *agents]}")
    shapes: dict[str, tuple[np.ndarray, tuple[int | None, ...]]] = {
        "time": (recording.time, (T,)), "qpos": (recording.qpos, (T, None))
    }  # fmt: skip
    shapes |= {f"values[{name!r}]": (array, (T,)) for name, array in recording.values.items()}
    shapes |= {name: (getattr(recording, name), (T, len(header.teams))) for name in ("reward", "score")}
    for what, width in (("actions", None), ("markers", None), ("terms", len(header.teams))):
        shapes |= {f"{what}[{name!r}]": (array, (T, width)) for name, array in getattr(recording, what).items()}
    for name, (array, shape) in shapes.items():
        fits = len(array.shape) == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits:
            raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    for step, text in recording.events:
        if not 0 <= step < T:
            raise ValueError(f"event {text!r} at step {step} of {T}")


def _check_crcs(data: bytes) -> None:
    """Compare the checksums of the data and summary sections, which together cover the whole file.

    Layout of the end: data, DataEnd (opcode, length, CRC: 13 bytes), summary, Footer (29 bytes, CRC last), magic.
    """
    whole = len(data) > 64 and data.startswith(MAGIC) and data.endswith(MAGIC)
    if whole:
        start, _, summary_crc = struct.unpack_from("<QQI", data, len(data) - 28)
        whole = 64 < start < len(data) and zlib.crc32(data[start:-12]) == summary_crc
        if whole:
            data_end = struct.pack("<BQI", Opcode.DATA_END, 4, zlib.crc32(data[: start - 13]))
            whole = data[start - 13 : start] == data_end
    if not whole:
        raise RecordingError(
            f"the recording ({len(data)} bytes) is damaged or cut short: its checksums do not match; fetch it again"
        )


def _header_to_text(header: RecordingHeader, steps: int) -> dict[str, str]:
    values = {"format": FORMAT, "steps": steps} | dataclasses.asdict(header)
    return {name: json.dumps(value, sort_keys=True) for name, value in values.items()}


def _header_from_text(metadata: Mapping[str, str]) -> tuple[RecordingHeader, int | None]:
    """Return the header, and the episode's number of steps, which older files do not state."""
    values = {name: json.loads(text) for name, text in metadata.items()}
    if (given := values.pop("format")) != FORMAT:
        raise ValueError(f"format {given}")
    steps = values.pop("steps", None)
    for name in ("sides", "digests", "teams", "score"):
        values[name] = tuple(values[name])
    values["agents"] = tuple(tuple(team) for team in values["agents"])
    values["arena"] = ArenaKey(*values["arena"])
    return RecordingHeader(**values), steps
