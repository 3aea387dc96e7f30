"""A velocity policy from elsewhere as a player of the duel: its command is the way to the enemy."""

from pathlib import Path

import numpy as np
import onnxruntime

FILE = Path(__file__).with_name("policy.onnx")
if not FILE.exists():
    raise FileNotFoundError(f"no {FILE.name} beside {Path(__file__).name}: copy your policy there")
POLICY = onnxruntime.InferenceSession(FILE)
ORDER = np.arange(12)  # ours[ORDER] are the joints in the policy's order
SCALE = 1.0  # rad of one unit of its action / rad of one unit of ours, the `scale` of my/go1.toml


def act(seen):
    """Return actions (worlds, 12) for observations (worlds, 63)."""
    joints, speeds, last = seen[:, 9:21], seen[:, 21:33], seen[:, 33:45]
    ahead, turn = seen[:, 56:57], seen[:, 57:58]  # the enemy's bearing as a unit vector, in its own heading frame
    command = np.concatenate([np.clip(ahead, 0.0, 1.0), np.zeros_like(ahead), turn], axis=1)
    own = [seen[:, :9], joints[:, ORDER], speeds[:, ORDER], last[:, ORDER] / SCALE, command]
    (wanted,) = POLICY.run(None, {POLICY.get_inputs()[0].name: np.concatenate(own, axis=1).astype(np.float32)})
    actions = np.empty_like(wanted)
    actions[:, ORDER] = wanted * SCALE
    return actions
