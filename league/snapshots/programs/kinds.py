"""The kinds of program, by the form of the word that names one. Loads nothing heavy."""

import re
from pathlib import Path

SUFFIXES = {".onnx": "onnx", ".pt": "torchscript", ".pth": "torchscript", ".ts": "torchscript"}
WORDS = {"onnx": "an ONNX file", "torchscript": "a TorchScript file", "python": "Python code"}


def kind_of(named: str) -> str | None:
    """Return the kind of program that a word on the command line names; None if it names none by its form."""
    first = named.split(",")[0]
    return "python" if re.search(r"\.py:\w+$", first) else SUFFIXES.get(Path(first).suffix.lower())
