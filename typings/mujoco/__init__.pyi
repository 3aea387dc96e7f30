"""For pyright only: MuJoCo is a C extension whose own stubs lack most names, so every name in it is Any."""

from typing import Any

def __getattr__(name: str) -> Any: ...
