"""Conversion of named arrays to safetensors bytes and back. Equal arrays always give equal bytes, hence equal digests.

Names are plain strings; nesting is written with '/' or '.'. The header carries no metadata, because safetensors writes
several metadata keys in no fixed order. The database row that names the bytes describes them.
"""

from collections.abc import Mapping

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from storage.errors import StorageError


def to_bytes(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return arrays of any shape and of bool, integer or float type as safetensors bytes, which depend on nothing else.

    Raises StorageError naming the first array whose type the format does not have (objects, text).
    """
    ordered = {name: np.asarray(arrays[name], order="C") for name in sorted(arrays)}
    for name, array in ordered.items():
        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
            raise StorageError(f"Array {name!r} has type {array.dtype}; bool, integer and float arrays can be stored.")
    return save(ordered)


def from_bytes(data: bytes) -> dict[str, np.ndarray]:
    """Return the arrays in `data`, by name in sorted order, writable.

    Raises StorageError when the bytes are not safetensors.
    """
    try:
        arrays = load(data)
    except (SafetensorError, KeyError) as error:  # KeyError: a type that NumPy does not have
        raise StorageError(f"These {len(data)} bytes are not stored arrays (safetensors): {error}") from error
    return {name: arrays[name] for name in sorted(arrays)}
