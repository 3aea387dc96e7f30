"""Cost of a recording: bytes per control step, and milliseconds to write it, read it and convert it for rerun.

    python -m benchmarks.recordings --out benchmarks/results/recordings-cpu.json

The match is synthetic: two teams of two robots of 10 geoms each roll about in MuJoCo for 1,000 control steps, which
compress as badly as real play. The conversion is what `league watch --save` does after its imports.
"""

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from dashboards import viewer
from league.system.packages.versions import versions
from scripts.record import make_parser, report, run_info, spread
from storage.recordings.recording import Recording, RecordingHeader, from_bytes, to_bytes
from storage.records import ArenaKey

STEPS, TEAMS, LEGS = 1000, ("blue", "red"), 4
AGENTS = tuple(tuple(f"{team}/{i}" for i in range(2)) for team in TEAMS)


def robot(agent: str, at: tuple[float, float]) -> str:
    """Return the MJCF of a robot: a trunk of two geoms, and four legs of two."""
    legs = "".join(
        f'<body pos="{x} {y} 0"><joint axis="0 1 0"/><geom type="capsule" size=".03 .1" pos="0 0 -.1"/>'
        f'<geom type="sphere" size=".04" pos="0 0 -.22"/></body>'
        for x in (-0.2, 0.2)
        for y in (-0.15, 0.15)
    )
    return (
        f'<body name="{agent}/base" pos="{at[0]} {at[1]} .4"><freejoint/><geom type="box" size=".25 .15 .06"/>'
        f'<geom type="ellipsoid" size=".1 .1 .05" pos="0 0 .08"/>{legs}</body>'
    )


def match() -> Recording:
    """Return a recording of 1,000 control steps of 20 ms with all kinds of data."""
    agents = [agent for team in AGENTS for agent in team]
    bodies = "".join(robot(agent, (i - 1.5, (-1) ** i * 0.3)) for i, agent in enumerate(agents))
    xml = f'<mujoco><option timestep=".005"/><worldbody><geom type="plane" size="0 0 1"/>{bodies}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data, rng, qpos = mujoco.MjData(model), np.random.default_rng(0), []
    for _ in range(STEPS):
        data.qfrc_applied[:] = rng.normal(0, 1.0, model.nv)
        mujoco.mj_step(model, data, 4)
        qpos.append(data.qpos.copy())
    header = RecordingHeader(
        "bench", 0, 1, 0, ArenaKey("made-up", "0" * 16, "c"), ("blue@1", "red@1"), ("a" * 64, "b" * 64), TEAMS, AGENTS,
        (1.0, 0.0), "blue@1 wins as blue", 0.02, {"ring": "circle"}, versions(),
    )  # fmt: skip
    return Recording(
        header, xml, 0.02 * np.arange(1, STEPS + 1), np.array(qpos),
        {agent: np.repeat(rng.normal(size=(STEPS // 5, LEGS)), 5, axis=0) for agent in agents},
        rng.normal(size=(STEPS, 2)), np.zeros((STEPS, 2)),
        {"ring": np.column_stack([np.zeros((STEPS, 2)), np.linspace(3, 2, STEPS)])},
        [(100, "contact"), (STEPS - 1, "out: red")],
        {name: rng.normal(size=(STEPS, 2)) for name in ("approach", "push", "result")},
        {team: np.repeat(rng.normal(size=STEPS // 5), 5) for team in TEAMS},
    )  # fmt: skip


def milliseconds(action: Callable[[], object], rounds: int) -> dict:
    """Return wall-clock and CPU time of `action()` in ms, after one call that is not counted."""
    action()
    took = []
    for _ in range(rounds):
        began = time.perf_counter(), time.process_time()
        action()
        took.append((1e3 * (time.perf_counter() - began[0]), 1e3 * (time.process_time() - began[1])))
    return {name: spread(list(each), 1) for name, each in zip(("wall", "cpu"), zip(*took, strict=True), strict=True)}


def main() -> None:
    """Measure and write the JSON."""
    parser = make_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=20)
    options = parser.parse_args()
    played = match()
    data = to_bytes(played)
    with tempfile.TemporaryDirectory() as folder:
        figures = {
            "steps": STEPS, "nq": played.qpos.shape[1], "geoms": played.xml.count("<geom"),
            "bytes_per_step": round(len(data) / STEPS, 1),
            "write_ms": milliseconds(lambda: to_bytes(played), options.rounds),
            "read_ms": milliseconds(lambda: from_bytes(data), options.rounds),
            "convert_for_rerun_ms": milliseconds(
                lambda: viewer.write_rrd(from_bytes(data), Path(folder, "match.rrd")), options.rounds
            ),
        }  # fmt: skip
    load = [round(each, 1) for each in os.getloadavg()]  # over 1, 5 and 15 minutes
    report({**run_info(options.commit), "load": load, **figures}, options.out)


if __name__ == "__main__":
    main()
