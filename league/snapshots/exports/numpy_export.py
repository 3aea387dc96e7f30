"""A frozen policy's network as a few lines of NumPy, for its model card: to read, and to run where nothing else is."""

from collections.abc import Mapping
from typing import Any

from agents.policy.constant_inputs import CONSTANT
from agents.settings import SQUASH_EDGE, VARIANCE_FLOOR

_ACTIVATION = {
    "tanh": "np.tanh(x)",
    "relu": "np.maximum(x, 0)",
    "elu": "np.where(x > 0, x, np.expm1(np.minimum(x, 0)))",
}
_LAYER_NORM = (
    "norm = lambda x, w: (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * p[w + '.weight']"
    " + p[w + '.bias']"
)


def numpy_lines(agent: Mapping[str, Any], number: int, file: str, silenced: bool = False) -> list[str]:
    """Return Python that defines `act` for one agent: from observations (n, obs) to actions (n, act).

    With `noise` of standard normal numbers it explores, as in the league. A recurrent one also takes its memory (n,
    units), zeros at first, and returns it.

    Args:
        agent: its description, see `league.snapshots.exports.networks.agents_of`.
        number: its number in the roster.
        file: the safetensors file of the policy.
        silenced: whether it acts as in an arena where it did not learn (`agents.policy.constant_inputs`).
    """
    units, normed = agent.get("recurrent", 0), agent["layer_norm"]

    logit = "x @ p['deviation.weight'].T + p['deviation.bias']" if agent["state_std"] else "p['std_logit']"
    lines = [
        "import numpy as np",
        "from safetensors.numpy import load_file",
        f"p = {{k.partition('/')[2]: v for k, v in load_file({file!r}).items() if k.startswith('{number}/')}}",
        *(_silencing_lines(agent) if silenced else []),
        *([_LAYER_NORM] if normed else []),
        f"def act(x, {'h, ' if units else ''}noise=0.0):",
        *(["    seen = x"] if agent.get("entities") else []),
        f"    deviation = np.sqrt(np.maximum(p['trunk.observation_var'], {VARIANCE_FLOOR}))",
        "    x = (x - p['trunk.observation_mean']) / deviation",
        "    x = np.clip(x, -p['trunk.observation_clip'], p['trunk.observation_clip'])",
        *_entity_lines(agent),
        *(["    x = norm(x, 'trunk.norm.0')"] if normed else []),
        f"    for i in range({len(agent['hidden'])}):",
        "        x = x @ p[f'trunk.hidden.{i}.weight'].T + p[f'trunk.hidden.{i}.bias']",
        f"        x = {_ACTIVATION[agent['activation']]}",
        *(["        x = norm(x, f'trunk.norm.{i + 1}')"] if normed else []),
    ]
    if units:
        lines += [
            "    a, b = (v @ p[f'gru.weight_{k}'].T + p[f'gru.bias_{k}'] for v, k in ((x, 'ih'), (h, 'hh')))",
            f"    r, z = np.split(1 / (1 + np.exp(-(a + b)[:, :{2 * units}])), 2, -1)",
            f"    n = np.tanh(a[:, {2 * units}:] + r * b[:, {2 * units}:])",
            f"    h = n + z * (h - n){'' if normed else '; x = h'}",
            *(["    x = norm(h, 'gru.norm')"] if normed else []),
        ]
    drawn = f"x @ p['mean.weight'].T + p['mean.bias'] + p['std_scale'] / (1 + np.exp(-({logit}))) * noise"
    answer = "u"
    if agent["squash"] is not None:
        answer = f"p['squash'] * np.clip(np.tanh(u / p['squash']), -{SQUASH_EDGE}, {SQUASH_EDGE})"
    return [*lines, f"    u = {drawn}", f"    return {answer}{', h' if units else ''}"]


def _silencing_lines(agent: Mapping[str, Any]) -> list[str]:
    """Return the lines after which constant inputs have no effect (`agents.policy.constant_inputs`)."""
    sets = agent.get("entities")
    first, own = "p['trunk.hidden.0.weight']", "still[p['trunk.own']]" if sets else "still"
    return [
        f"still = p['trunk.observation_var'] < {CONSTANT}  # inputs that never moved where it learnt",
        "p['trunk.observation_var'] = np.where(still, np.float32(1), p['trunk.observation_var'])",
        *([f"own = np.pad({own}, (0, {first}.shape[1] - len({own})))"] if sets and not agent["layer_norm"] else []),
        *([f"{first} = np.where({'own' if sets else own}, 0, {first})"] if not agent["layer_norm"] else []),
        *([f"for e in (f'trunk.entities.{{i}}.' for i in range({len(sets)})):"] if sets else []),
        *(["    w, rests = e + 'layers.0.weight', still[p[e + 'index']].all(0)"] if sets else []),
        *(["    p[w] = np.where(rests, 0, p[w])"] if sets else []),
    ]


def _entity_lines(agent: Mapping[str, Any]) -> list[str]:
    """Return the lines that encode sets of entities (`agents.policy.entities`)."""
    if not (sets := agent.get("entities")):
        return []
    return [
        f"    f = lambda x: {_ACTIVATION[agent['activation']]}",
        "    parts = [x[:, p['trunk.own']]]",
        f"    for e in (f'trunk.entities.{{i}}.' for i in range({len(sets)})):",
        "        rows, there = (v[:, p[e + 'index']] for v in (x, seen))",
        "        there = (there != 0).any(-1, keepdims=True)",
        "        for i in range(2):",
        "            rows = rows @ p[f'{e}layers.{i}.weight'].T + p[f'{e}layers.{i}.bias']",
        "            rows = f(rows)",
        "        some, most = there.any(1), np.where(there, rows, -np.inf).max(1)",
        "        parts += [(rows * there).sum(1) / np.maximum(there.sum(1), 1), np.where(some, most, 0)]",
        "    x = np.concatenate(parts, -1)",
    ]
