"""A frozen policy as programs for robots: an ONNX or a TorchScript file for each of its agents."""

import json
from collections.abc import Collection
from pathlib import Path
from typing import Literal

from league.snapshots.policy_file import Policy

Format = Literal["onnx", "torchscript"]
SUFFIX: dict[Format, str] = {"onnx": ".onnx", "torchscript": ".pt"}


def stem(path: Path) -> Path:
    """Return a file's path without the suffix of a policy's file."""
    return path.with_suffix("") if path.suffix in (".safetensors", *SUFFIX.values()) else path


def programs(policy: Policy, base: Path, formats: Collection[Format]) -> dict[Path, tuple[int, bytes]]:
    """Return the files to write, with agent and content: `base`.onnx, or `base`-0.onnx, ... for several agents.

    Raises StorageError if the package onnx is missing.
    """
    found, about = {}, policy.about
    for number, agent in enumerate(about["agents"]):
        own = {k.partition("/")[2]: v for k, v in policy.arrays.items() if k.startswith(f"{number}/")}
        name = f"{base.name}-{number}" if len(about["agents"]) > 1 else base.name
        for format in formats:
            if format == "onnx":
                from league.snapshots.exports.onnx_export import onnx_bytes

                metadata = {"league": about["league"], "name": about["name"], "agent": str(number)}
                metadata |= {"robot_league": json.dumps(agent, sort_keys=True), "digest": about["digest"]}
                data = onnx_bytes(own, agent, metadata)
            else:
                from league.snapshots.exports.torchscript_export import torchscript_bytes

                data = torchscript_bytes(own, agent)
            found[base.with_name(f"{name}{SUFFIX[format]}")] = number, data
    return found
