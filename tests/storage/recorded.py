"""Recordings of a match that nobody played, as values."""

import numpy as np

from storage.recordings.recording import Recording, RecordingHeader
from storage.records import ArenaKey

HEADER = RecordingHeader(
    league="demo",
    match=7,
    seed=2**63 + 1,
    world=3,
    arena=ArenaKey("sumo", "c0ffee", "warp"),
    sides=("blue@16", "red@8"),
    digests=("ab" * 32, "cd" * 32),
    teams=("blue", "red"),
    agents=(("blue/0", "blue/1"), ("red/0",)),
    score=(1.0, 0.0),
    outcome="win blue",
    dt=0.02,
    marker_kinds={"ring": "circle"},
    versions={"mujoco": "3.17.0", "jax": "0.11"},
    created=1.7e9 + 0.123456789,
)


def recording(steps=40, **changes):
    """Every array holds awkward values: irrational, negative zero, infinities, NaN, denormals."""
    rng = np.random.default_rng(0)
    qpos = rng.standard_normal((steps, 14))
    qpos[0, :5] = [-0.0, np.inf, -np.inf, np.nan, 5e-324]
    values = dict(
        header=HEADER,
        xml="<mujoco model='é'/>",
        time=np.arange(1, steps + 1) * 0.02,
        qpos=qpos,
        actions={
            "red/0": rng.standard_normal((steps, 2)),
            "blue/0": rng.standard_normal((steps, 3)).astype(np.float32),
            "blue/1": rng.standard_normal((steps, 1)),
        },
        reward=rng.standard_normal((steps, 2)),
        score=np.cumsum(rng.integers(0, 2, (steps, 2)), axis=0),
        markers={"ring": np.stack([np.zeros(steps), np.zeros(steps), np.linspace(2, 1, steps)], 1)},
        events=[(5, "red/0 leaves the ring"), (5, "win blue"), (39, "ende ✓")],
        terms={"win": rng.standard_normal((steps, 2)), "effort": np.full((steps, 2), -0.0)},
        values={"red/0": rng.standard_normal(steps), "blue": rng.standard_normal(steps).astype(np.float32)},
    )
    return Recording(**(values | changes))
