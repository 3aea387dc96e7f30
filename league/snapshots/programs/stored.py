"""Programs of others as the bytes of a snapshot, see `storage.blobs.programs`.

They are described by their kind (`onnx`, `torchscript`, `python`), and by the roster's agents with their sizes and the
file by which each acts. Of a Python callable the path, the name and the file's SHA-256 are stored, and no code: a store
or an archive of a stranger runs no Python, unless this very file is on this machine.
"""

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from agents.policy.host_policy import Actor, HostPolicy
from arenas.rosters import roster_agents
from league.snapshots.programs.kinds import kind_of
from league.snapshots.programs.model import AgentSizes, Model, ProgramError
from storage.blobs import programs
from storage.blobs.files import open_file

LIMIT = 2**28  # bytes of a file
TRIAL, TIMED = 3, 64  # worlds
ZIP = b"PK\x03\x04"  # the first bytes of a TorchScript file


@dataclass(frozen=True)
class Program:
    """A policy as a program for each agent of a roster, checked: each has acted on a few observations.

    `how` tells how it is called: batched, or single, one world at a time. `seconds` is the time of one decision of all
    its agents in TIMED worlds.
    """

    kind: str
    files: tuple[tuple[str, bytes], ...]  # name and content; of a Python callable the content is empty
    agents: tuple[dict[str, Any], ...]  # kind, observation, action, file (its index), how, and what the kind needs
    seconds: float = 0.0

    def to_bytes(self) -> bytes:
        """Return the bytes of a snapshot."""
        return programs.to_bytes(self.files, {"kind": self.kind, "agents": self.agents})

    @property
    def singles(self) -> bool:
        """Return whether some agent's program is called for one world at a time."""
        return any(agent["how"] == "single" for agent in self.agents)


def read(kind: str, names: Sequence[str], roster: str) -> Program:
    """Read the programs of a roster: one for all its agents, or one for each. Raises ProgramError, one line."""
    agents = sizes(roster)
    if len({kind_of(name) for name in names} - {None}) > 1:
        raise ProgramError(f"{','.join(names)}: give programs of one kind, x.onnx, x.pt or x.py:function")
    if len(names) not in (1, len(agents)):
        raise ProgramError(
            f"{len(names)} files for the {len(agents)} agents of {roster}: give one for all, or one for each"
        )
    files, found = [], []
    for name in names:
        if kind == "python":
            path, _, function = name.rpartition(":")
            files.append((f"{Path(path).absolute()}:{function}", b""))
        else:
            files.append((name, _content(Path(name), kind)))
    for i, agent in enumerate(agents):
        file = i if len(files) > 1 else 0
        found.append({**agent._asdict(), "file": file, **_tried(kind, files[file], agent)})
    short = tuple((name if kind == "python" else Path(name).name, data) for name, data in files)
    program = Program(kind, short, tuple(found))
    return replace(program, seconds=_timed(program))


def of_bytes(files: Sequence[tuple[str, bytes]], roster: str) -> Program:
    """Return the program of a roster with a file for each agent, ONNX or TorchScript, by name and content.

    Raises ProgramError, one line.
    """
    kind = "torchscript" if files[0][1].startswith(ZIP) else "onnx"
    agents = sizes(roster)
    about = [{**agent._asdict(), "file": i, **_tried(kind, files[i], agent)} for i, agent in enumerate(agents)]
    return Program(kind, tuple(files), tuple(about))


def sizes(roster: str) -> list[AgentSizes]:
    """Return the agents of a roster."""
    found = []
    for agent in roster_agents(roster):
        kind, observation, action = agent.rsplit(":", 2)
        found.append(AgentSizes(kind, int(observation), int(action)))
    return found


def host_policies(data: bytes, name: str, report: Callable[[str], None] | None = None) -> list[HostPolicy]:
    """Return the policies of a snapshot, one for each agent of its roster; `report` as for `reporter`.

    Raises ProgramError if a program cannot be loaded on this machine.
    """
    (files, about), policies = programs.from_bytes(data), []
    for i, agent in enumerate(about["agents"]):
        file = files[agent["file"]]
        report_fault = reporter(f"{name} ({file[0]})", i, report)
        policies.append(HostPolicy(_maker(about["kind"], file, agent), agent["action"], report_fault))
    return policies


def exchange(policies: Sequence[HostPolicy], data: bytes) -> None:
    """Let policies of the same roster act by the programs of other bytes; what they remember of episodes stays."""
    files, about = programs.from_bytes(data)
    for policy, agent in zip(policies, about["agents"], strict=True):
        policy.exchange(_maker(about["kind"], files[agent["file"]], agent))


def reporter(name: str, agent: int, report: Callable[[str], None] | None = None) -> Callable[[str], None]:
    """Return a function that reports an agent's first fault, to `report`, by default stderr, in a line."""
    tell = report or (lambda line: print(f"league: {line}", file=sys.stderr))
    return lambda what: tell(f"{name}, agent {agent} {what}; it forfeits such episodes, which are void by its fault")


def _tried(kind: str, file: tuple[str, bytes], agent: AgentSizes) -> dict[str, Any]:
    """Try a program on a few observations; return how it is called, and for a Python callable its file's digest.

    Raises ProgramError unless it returns finite actions of the right shape.
    """
    name, data = file
    if kind == "python":
        from league.snapshots.programs import callables

        policy, digest = callables.load(name)
        make, how = callables.maker(policy, agent, name)
        _trial(make(), name, agent)
        return {"how": how, "digest": digest}
    model = _model(kind, data, name, agent)
    try:
        _trial(model.actor(agent), name, agent)
    except ProgramError:
        if model.rows is not None:
            raise
        _trial(replace(model, rows=1).actor(agent), name, agent)  # it takes a single world, and does not tell so
        return {"how": "single"}
    return {"how": "single" if model.rows == 1 else "batched"}


def _reason(error: Exception) -> str:
    """Return an error's type and text in one line; TorchScript tells the cause last, below a long traceback."""
    lines = [line for line in map(str.strip, str(error).splitlines()) if line]
    if "TorchScript interpreter" in str(error):
        return lines[-1][:200]
    return f"{type(error).__name__}: {' '.join(' '.join(lines).split())[:200]}"


def _trial(actor: Actor, name: str, agent: AgentSizes) -> None:
    seen, noise = agent.trial(TRIAL)
    for begins in (True, False):
        try:
            found = np.asarray(actor(seen, noise, np.full(TRIAL, begins)))
        except Exception as error:  # a stranger's code
            sees = f"standard normal observations ({TRIAL}, {agent.observation})"
            raise ProgramError(f"{name}: {sees} raise {_reason(error)}") from None
        if found.shape != (TRIAL, agent.action):
            raise ProgramError(
                f"{name}: {TRIAL} observations give actions of shape {found.shape}, and a {agent.kind} of this team"
                f" acts with {agent.action} numbers: ({TRIAL}, {agent.action})"
            )
        if found.dtype.kind not in "fiu" or not np.isfinite(found).all():
            raise ProgramError(
                f"{name}: standard normal observations give actions that are not finite numbers; clip what it divides"
                " by, and what it takes roots and logarithms of"
            )


def parameters(program: Program) -> int:
    """Return the number of parameters of a program's largest network; 0 for Python, where it cannot be known."""
    if program.kind == "python":
        return 0
    from league.snapshots.programs import onnx_model, torchscript_model

    count = onnx_model.parameters if program.kind == "onnx" else torchscript_model.parameters
    return max(count(data, name) for name, data in program.files)


def _maker(kind: str, file: tuple[str, bytes], agent: dict[str, Any]) -> Callable[[], Actor]:
    (name, data), known = file, AgentSizes(agent["kind"], agent["observation"], agent["action"])
    if kind == "python":
        from league.snapshots.programs import callables

        policy, _ = callables.load(name, agent["digest"])
        actor = callables.BatchedCallable if agent["how"] == "batched" else callables.SingleCallable
        return lambda: actor(policy)
    model = _model(kind, data, name, known)
    if agent["how"] == "single":
        model = replace(model, rows=1)
    return lambda: model.actor(known)


def _model(kind: str, data: bytes, name: str, agent: AgentSizes) -> Model:
    if kind == "onnx":
        from league.snapshots.programs import onnx_model as format
    elif kind == "torchscript":
        from league.snapshots.programs import torchscript_model as format
    else:
        raise ProgramError(f"{name} is a program of kind {kind!r}, which this version cannot run: update robot-league")
    return format.load(data, name, agent)


def _content(path: Path, kind: str) -> bytes:
    """Return a file's bytes, of an ONNX file with the weights beside it."""
    with open_file(path) as file:
        data = file.read(LIMIT + 1)
    if kind == "onnx" and len(data) <= LIMIT:
        from league.snapshots.programs import onnx_model

        data = onnx_model.whole(data, path)
    if len(data) > LIMIT:
        raise ProgramError(f"{path} has more than {LIMIT:,} bytes, too many for a policy of a league")
    return data


def _timed(program: Program) -> float:
    """Return the seconds of a decision of all agents in TIMED worlds, the least of three."""
    policies = host_policies(program.to_bytes(), "", lambda line: None)
    times = []
    for begins in (True, False, False):
        began = time.perf_counter()
        for i, (policy, agent) in enumerate(zip(policies, program.agents, strict=True)):
            seen, noise = AgentSizes(agent["kind"], agent["observation"], agent["action"]).trial(TIMED)
            policy.act(str(i), 0, seen, noise, np.full(TIMED, begins))
        times.append(time.perf_counter() - began)
    return min(times)
