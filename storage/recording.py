"""Recordings of matches: one episode as one MCAP file that replays on its own.

The file holds the truth and no pictures: joint positions, actions, rewards and their named terms, score, markers and
events, with the compiled MJCF attached. GPU physics is not bit-reproducible, so a replay comes from these recorded
states, never from the seed.

    profile     league
    metadata    league.match: the header, each value as JSON
    attachment  arena.xml
    /match/step   league.v1.Step, one per control step, sequence = step, log time = step × dt
    /match/event  league.v1.Event

The same content gives the same bytes, and every byte is under a checksum.
"""

import dataclasses
import functools
import io
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from storage.errors import StorageError
from storage.records import ArenaKey

FORMAT = 1
MAGIC = b"\x89MCAP0\r\n"


class RecordingError(StorageError):
    """These bytes are not a whole, undamaged recording of a match."""


@dataclass(frozen=True)
class RecordingHeader:
    """Who played what, and how it ended. Tuples with one entry per side are in the arena's team order."""

    league: str
    match: int  # 0 where the episode belongs to no stored match
    seed: int
    world: int  # which world of the match's batch
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
    """One episode of T control steps. Arrays of any float type are kept as float64, which loses nothing.

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
    terms: Mapping[str, np.ndarray] = field(default_factory=dict)  # name -> (T, teams), what the reward is made of

    def __post_init__(self) -> None:
        for name in ("time", "qpos", "reward", "score"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))
        for name in ("actions", "markers", "terms"):
            arrays = {key: np.asarray(value, np.float64) for key, value in getattr(self, name).items()}
            object.__setattr__(self, name, arrays)
        object.__setattr__(self, "events", tuple((int(step), str(text)) for step, text in self.events))
        _check(self)

    @property
    def steps(self) -> int:
        """T, the number of control steps."""
        return len(self.time)


def to_bytes(recording: Recording) -> bytes:
    """Return the recording as an MCAP file."""
    header, out = recording.header, io.BytesIO()
    writer = Writer(out, enable_data_crcs=True)
    writer.start(profile="league", library="robot-league")
    writer.add_metadata("league.match", _header_to_text(header))
    writer.add_attachment(0, 0, "arena.xml", "application/xml", recording.xml.encode())
    for topic, kind, messages in (
        ("/match/step", "Step", _step_messages(recording)),
        ("/match/event", "Event", _event_messages(recording)),
    ):
        channel = writer.register_channel(topic, "protobuf", register_schema(writer, _message_classes()[kind]))
        for message in messages:
            at = round(message.step * header.dt * 1e9)  # ns
            writer.add_message(channel, at, message.SerializeToString(), at, sequence=message.step)
    writer.finish()
    return out.getvalue()


def from_bytes(data: bytes) -> Recording:
    """Read what `to_bytes` wrote. Raises RecordingError if the bytes are damaged, cut short or something else."""
    _check_crcs(data)
    try:
        return _parse(data)
    except Exception as error:  # the bytes are as they were written, so another program or version wrote them
        raise RecordingError(f"not a match recording of format {FORMAT}: {error!r}") from error


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
    shapes = {"time": (recording.time, (T,)), "qpos": (recording.qpos, (T, None))}
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
    """Compare the checksums of the data and summary sections, which between them cover the whole file.

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


def _parse(data: bytes) -> Recording:
    header: RecordingHeader | None = None
    xml = ""
    topics: dict[int, str] = {}
    steps: list[Any] = []
    events: list[Any] = []
    classes = _message_classes()
    for record in StreamReader(io.BytesIO(data), record_size_limit=len(data)).records:
        if isinstance(record, Metadata) and record.name == "league.match":
            header = _header_from_text(record.metadata)
        elif isinstance(record, Attachment) and record.name == "arena.xml":
            xml = record.data.decode()
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and topics[record.channel_id] == "/match/step":
            steps.append(classes["Step"].FromString(record.data))
        elif isinstance(record, Message) and topics[record.channel_id] == "/match/event":
            events.append(classes["Event"].FromString(record.data))
    if header is None:
        raise ValueError("no league.match metadata")

    def rows(values: Callable[[Any], Any]) -> np.ndarray:
        return np.stack([np.array(values(message), np.float64) for message in steps])

    def named(what: str) -> dict[str, np.ndarray]:
        first = getattr(steps[0], what)
        return {each.name: rows(lambda m, i=i: getattr(m, what)[i].values) for i, each in enumerate(first)}

    return Recording(
        header=header,
        xml=xml,
        time=rows(lambda m: m.time),
        qpos=rows(lambda m: m.qpos),
        actions=named("actions"),
        reward=rows(lambda m: m.reward),
        score=rows(lambda m: m.score),
        markers=named("markers"),
        events=[(event.step, event.text) for event in events],
        terms=named("terms"),
    )


def _step_messages(recording: Recording) -> Iterator[Any]:
    Step, Named = _message_classes()["Step"], _message_classes()["Named"]
    time, qpos = recording.time.tolist(), recording.qpos.tolist()
    reward, score = recording.reward.tolist(), recording.score.tolist()
    named = {  # by name, so that the order of a caller's dict does not change the file's digest
        what: [(name, array.tolist()) for name, array in sorted(getattr(recording, what).items())]
        for what in ("actions", "markers", "terms")
    }
    for t in range(recording.steps):
        yield Step(
            step=t,
            time=time[t],
            qpos=qpos[t],
            reward=reward[t],
            score=score[t],
            **{what: [Named(name=name, values=rows[t]) for name, rows in arrays] for what, arrays in named.items()},
        )


def _event_messages(recording: Recording) -> Iterator[Any]:
    Event = _message_classes()["Event"]
    for step, text in recording.events:
        yield Event(step=step, text=text)


def _header_to_text(header: RecordingHeader) -> dict[str, str]:
    values = {"format": FORMAT} | dataclasses.asdict(header)
    return {name: json.dumps(value, sort_keys=True) for name, value in values.items()}


def _header_from_text(metadata: Mapping[str, str]) -> RecordingHeader:
    values = {name: json.loads(text) for name, text in metadata.items()}
    if (given := values.pop("format")) != FORMAT:
        raise ValueError(f"format {given}")
    for name in ("sides", "digests", "teams", "score"):
        values[name] = tuple(values[name])
    values["agents"] = tuple(tuple(team) for team in values["agents"])
    values["arena"] = ArenaKey(*values["arena"])
    return RecordingHeader(**values)


@functools.cache
def _message_classes() -> dict[str, Any]:
    """The protobuf classes of league.v1, from a descriptor built here: generated files check the runtime's version.

    Arrays are packed repeated doubles, which on the wire are a length and the little-endian array, so that other MCAP
    tools can plot them.
    """
    Field = descriptor_pb2.FieldDescriptorProto
    one, many = Field.LABEL_OPTIONAL, Field.LABEL_REPEATED
    types = {"uint64": Field.TYPE_UINT64, "double": Field.TYPE_DOUBLE, "string": Field.TYPE_STRING}
    messages = {
        "Named": [("name", "string", one), ("values", "double", many)],
        "Step": [
            ("step", "uint64", one),
            ("time", "double", one),
            ("qpos", "double", many),
            ("actions", "Named", many),
            ("reward", "double", many),
            ("score", "double", many),
            ("markers", "Named", many),
            ("terms", "Named", many),
        ],
        "Event": [("step", "uint64", one), ("text", "string", one)],
    }
    file = descriptor_pb2.FileDescriptorProto(name="league/v1/match.proto", package="league.v1", syntax="proto3")
    for message, fields in messages.items():
        proto = file.message_type.add(name=message)
        for number, (field_name, kind, label) in enumerate(fields, 1):
            spec = proto.field.add(name=field_name, number=number, label=label)
            if kind in types:
                spec.type = types[kind]
            else:
                spec.type, spec.type_name = Field.TYPE_MESSAGE, f".league.v1.{kind}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"league.v1.{name}")) for name in messages}
