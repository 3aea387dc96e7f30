"""What is left of damaged recordings: every chunk that is whole, and in words what is not."""

import io
import re
from contextlib import suppress

import numpy as np
import pytest
from mcap.reader import make_reader

from storage.recordings.recording import RecordingError, from_bytes, headers, to_bytes
from storage.recordings.salvage import salvage
from tests.storage.recorded import HEADER, recording

STEPS = 900


@pytest.fixture(scope="module")
def whole():
    return recording(STEPS, events=[(5, "out: red"), (STEPS - 1, "win blue")])


@pytest.fixture(scope="module")
def data(whole):
    return to_bytes(whole)


def chunks(data: bytes) -> list[tuple[int, int]]:
    """Where the chunks stand."""
    indexes = make_reader(io.BytesIO(data)).get_summary().chunk_indexes
    return [(index.chunk_start_offset, index.chunk_start_offset + index.chunk_length) for index in indexes]


def test_chunks_are_of_64_kibibytes(data):
    sizes = [index.uncompressed_size for index in make_reader(io.BytesIO(data)).get_summary().chunk_indexes]
    assert len(sizes) > 3
    assert all(size < 66 * 1024 for size in sizes)


def test_of_a_whole_file_nothing_is_missing(data, whole):
    found, missing = salvage(data)
    assert missing == ""
    assert found.qpos.tobytes() == whole.qpos.tobytes()
    assert found.events == whole.events


@pytest.mark.parametrize("number", [0, 1, -1])
def test_a_flipped_bit_costs_one_chunk_and_is_told(data, whole, number):
    begin, end = chunks(data)[number]
    damaged = bytearray(data)
    damaged[(begin + end) // 2] ^= 4
    with pytest.raises(RecordingError):
        from_bytes(bytes(damaged))
    found, missing = salvage(bytes(damaged))
    first, last, total = (int(text.replace(",", "")) for text in re.findall(r"steps ([\d,]+) to ([\d,]+).* of ([\d,]+)",
                                                                           missing)[0])  # fmt: skip
    assert total == STEPS
    kept = np.r_[0:first, last + 1 : STEPS]
    assert 0 < last - first < STEPS / 2
    assert found.qpos.tobytes() == whole.qpos[kept].tobytes()
    assert found.terms["win"].tobytes() == whole.terms["win"][kept].tobytes()


def test_cut_short_anywhere_it_gives_all_chunks_that_are_there(data, whole):
    ends = [end for _, end in chunks(data)]
    for length in range(chunks(data)[0][0], ends[-1], 7919):
        there = sum(end <= length for end in ends)
        if not there:
            with pytest.raises(RecordingError, match="nothing of it is left"):
                salvage(data[:length])
            continue
        found, missing = salvage(data[:length])
        assert found.qpos.tobytes() == whole.qpos[: found.steps].tobytes()
        assert f"steps {found.steps:,} to {STEPS - 1:,}" in missing


def test_a_record_of_a_damaged_length_costs_itself_alone(data):
    begin, _ = chunks(data)[1]
    damaged = bytearray(data)
    damaged[begin + 3] ^= 0xFF
    assert salvage(bytes(damaged))[1].count(" to ") == 2  # one gap: in steps, in seconds


def test_no_byte_that_changes_ends_in_anything_but_an_error_or_steps_as_they_were():
    short = recording(30, events=[(3, "out: red")])
    data = to_bytes(short)
    for at in range(0, len(data), 11):
        damaged = bytearray(data)
        damaged[at] ^= 0x10
        with suppress(RecordingError):
            assert salvage(bytes(damaged))[0].qpos.tobytes() == short.qpos.tobytes()


def test_several_episodes_of_a_match_are_in_one_file(whole):
    swapped = recording(40, qpos=np.ones((40, 14)))
    data = to_bytes(whole, swapped)
    assert headers(data) == [HEADER, HEADER]
    assert from_bytes(data).qpos.tobytes() == whole.qpos.tobytes()
    assert from_bytes(data, 1).qpos.tobytes() == swapped.qpos.tobytes()
    assert from_bytes(data, 1).events == swapped.events
    assert salvage(data[: -len(data) // 20], 0)[0].steps <= STEPS
    with pytest.raises(RecordingError, match="no episode 2"):
        from_bytes(data, 2)
    with pytest.raises(RecordingError, match="not a match recording"):
        headers(b"something else")
