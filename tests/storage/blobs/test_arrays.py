import json
import struct

import numpy as np
import pytest

from storage.blobs.arrays import from_bytes, to_bytes
from storage.errors import StorageError

ARRAYS = {
    "blue/0/w": np.arange(6.0, dtype=np.float32).reshape(2, 3),
    "blue/0/b": np.array([0.1, -0.2]),
    "step": np.array(7, dtype=np.int64),
    "key": np.array([1, 2**32 - 1], dtype=np.uint32),
    "alive": np.array([True, False]),
    "none": np.zeros((0, 3), dtype=np.float16),
}


def test_arrays_return_with_their_values_types_and_shapes():
    back = from_bytes(to_bytes(ARRAYS))
    assert list(back) == sorted(ARRAYS)
    for name, array in ARRAYS.items():
        assert back[name].dtype == array.dtype
        assert back[name].shape == array.shape
        np.testing.assert_array_equal(back[name], array)
        back[name][...] = 0  # a learner goes on in place


def test_bytes_depend_on_values_alone():
    strided = {name: ARRAYS[name].copy(order="F") for name in reversed(ARRAYS)}
    assert to_bytes(strided) == to_bytes(ARRAYS)
    assert to_bytes({**ARRAYS, "step": np.array(8, dtype=np.int64)}) != to_bytes(ARRAYS)


@pytest.mark.parametrize("array", [np.array(["text"]), np.array([None]), np.array([1j])])
def test_an_array_that_cannot_be_stored_is_named(array: np.ndarray):
    with pytest.raises(StorageError, match="'blue/0/w'"):
        to_bytes({"fine": np.zeros(1), "blue/0/w": array})


def of_another_program() -> bytes:
    header = json.dumps({"a": {"dtype": "BF16", "shape": [1], "data_offsets": [0, 2]}}).encode()
    return struct.pack("<Q", len(header)) + header + b"\0\0"


@pytest.mark.parametrize("data", [b"", b"hello", to_bytes(ARRAYS)[:-1], of_another_program()])
def test_other_bytes_are_refused(data: bytes):
    with pytest.raises(StorageError, match="not stored arrays"):
        from_bytes(data)
