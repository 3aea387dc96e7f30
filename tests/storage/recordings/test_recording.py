import dataclasses
import io

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from storage.recordings.recording import RecordingError, from_bytes, to_bytes
from tests.storage.recorded import HEADER, recording


def test_what_is_read_is_what_was_written_bit_for_bit():
    written = recording()
    read = from_bytes(to_bytes(written))

    assert read.header == written.header
    assert (read.xml, read.events) == (written.xml, written.events)
    for name in ("time", "qpos", "reward", "score"):
        assert getattr(read, name).tobytes() == getattr(written, name).tobytes(), name
        assert getattr(read, name).shape == getattr(written, name).shape, name
    for name in ("actions", "markers", "terms", "values"):
        arrays = getattr(written, name)
        assert set(getattr(read, name)) == set(arrays)
        for key, array in arrays.items():
            assert getattr(read, name)[key].tobytes() == array.tobytes(), (name, key)


def test_float32_actions_come_back_with_the_same_values():
    written = recording().actions["blue/0"]
    assert np.array_equal(written.astype(np.float32), from_bytes(to_bytes(recording())).actions["blue/0"])


def test_same_content_gives_same_bytes_whatever_the_order_of_a_dict():
    first = recording()
    again = recording(**{name: dict(reversed(getattr(first, name).items())) for name in ("actions", "terms")})
    assert to_bytes(first) == to_bytes(again)
    assert to_bytes(first) == to_bytes(from_bytes(to_bytes(first)))


def test_an_arena_of_one_team_and_no_bodies_is_recorded_too():
    one = dataclasses.replace(
        *(HEADER,),
        **{"sides": ("blue@16",), "digests": ("ab" * 32,), "teams": ("blue",), "agents": (("blue/0", "blue/1"),)},
        **{"score": (1.0,), "marker_kinds": {}},
    )
    written = recording(
        **{"header": one, "xml": "", "qpos": np.zeros((40, 0)), "reward": np.zeros((40, 1)), "score": np.ones((40, 1))},
        **{"actions": {"blue/0": np.ones((40, 3)), "blue/1": np.zeros((40, 0))}, "markers": {}},
        **{"events": [], "terms": {}, "values": {}},
    )
    read = from_bytes(to_bytes(written))
    assert (read.header, read.xml, read.events) == (one, "", ())
    assert read.qpos.shape == (40, 0)
    assert {name: array.shape for name, array in read.actions.items()} == {"blue/0": (40, 3), "blue/1": (40, 0)}
    np.testing.assert_array_equal(read.score, np.ones((40, 1)))


def test_a_changed_value_changes_the_bytes():
    qpos, effort = recording().qpos.copy(), recording().terms["effort"].copy()
    qpos[-1, -1] = np.nextafter(qpos[-1, -1], 9)
    assert to_bytes(recording(qpos=qpos)) != to_bytes(recording())
    effort[0, 1] = 0.0  # for -0.0
    assert to_bytes(recording(terms=recording().terms | {"effort": effort})) != to_bytes(recording())


def test_a_match_whose_rewards_have_no_named_terms_and_that_no_critic_saw_comes_back_without():
    plain = to_bytes(recording(terms={}, values={}))
    assert from_bytes(plain).terms == from_bytes(plain).values == {}
    reader = make_reader(io.BytesIO(plain), decoder_factories=[DecoderFactory()])
    assert not any(step.decoded_message.values for step in reader.iter_decoded_messages(topics="/match/step"))


def test_every_damaged_byte_is_noticed():
    data = to_bytes(recording(steps=40))
    for at in range(len(data)):
        damaged = bytearray(data)
        damaged[at] ^= 0x10
        with pytest.raises(RecordingError):
            from_bytes(bytes(damaged))


def test_a_truncated_file_is_noticed_at_every_length():
    data = to_bytes(recording())
    for length in range(len(data)):
        with pytest.raises(RecordingError):
            from_bytes(data[:length])
    with pytest.raises(RecordingError, match="damaged or cut short"):
        from_bytes(data + b"\0")


def test_a_sound_mcap_file_of_something_else_is_refused(monkeypatch):
    monkeypatch.setattr("storage.recordings.recording.FORMAT", 99)
    from_another_version = to_bytes(recording())
    monkeypatch.undo()
    with pytest.raises(RecordingError, match="format 99"):
        from_bytes(from_another_version)


def test_other_mcap_tools_read_the_file():
    reader = make_reader(io.BytesIO(to_bytes(recording())), validate_crcs=True, decoder_factories=[DecoderFactory()])
    steps = list(reader.iter_decoded_messages(topics="/match/step"))
    events = list(reader.iter_decoded_messages(topics="/match/event"))

    assert reader.get_header().profile == "league"
    assert [a.name for a in reader.iter_attachments()] == ["arena.xml"]
    assert [m.name for m in reader.iter_metadata()] == ["league.match"]
    assert [s.message.sequence for s in steps] == list(range(40))
    assert [s.message.log_time for s in steps] == [t * 20_000_000 for t in range(40)]
    assert list(steps[7].decoded_message.qpos) == recording().qpos[7].tolist()
    assert [term.name for term in steps[7].decoded_message.terms] == ["effort", "win"]
    assert list(steps[7].decoded_message.terms[1].values) == recording().terms["win"][7].tolist()
    assert {v.name: list(v.values) for v in steps[7].decoded_message.values} == {
        who: [values[7]] for who, values in recording().values.items()
    }
    assert [(e.message.log_time, e.decoded_message.text) for e in events] == [
        (100_000_000, "red/0 leaves the ring"),
        (100_000_000, "win blue"),
        (780_000_000, "ende ✓"),
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"qpos": np.zeros((39, 14))}, r"qpos has shape \(39, 14\), expected \(40, None\)"),
        ({"reward": np.zeros(40)}, r"reward has shape \(40,\), expected \(40, 2\)"),
        ({"score": np.zeros((40, 3))}, r"score has shape \(40, 3\)"),
        ({"actions": {"blue/0": np.zeros((40, 3))}}, r"the header names \['blue/0', 'blue/1', 'red/0'\]"),
        ({"markers": {}}, "ring"),
        ({"terms": {"win": np.zeros((40, 3))}}, r"terms\['win'\] has shape \(40, 3\), expected \(40, 2\)"),
        ({"values": {"blue": np.zeros((40, 1))}}, r"values\['blue'\] has shape \(40, 1\), expected \(40,\)"),
        ({"values": {"green": np.zeros(40)}}, r"values of \['green'\], but the header names \['blue', 'red', 'blue/0'"),
        ({"events": [(40, "too late")]}, "'too late' at step 40 of 40"),
        ({"header": dataclasses.replace(HEADER, score=(1.0,))}, "score has 1 entries for 2 teams"),
        ({"time": np.zeros(0)}, "at least one step"),
    ],
)
def test_arrays_that_do_not_fit_are_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        recording(**changes)
