"""Stable-Baselines3's PPO as a player of the duel: trains when it is run, acts when it is imported."""

from pathlib import Path

from stable_baselines3 import PPO

import arenas

DECISIONS = 60_000
FILE = Path(__file__).with_name("ppo.zip")

if __name__ == "__main__":
    worlds = arenas.stable_baselines("my/duel.py:duel", "blue", "idle", num_envs=64)
    settings = {"log_std_init": -2.0}
    learner = PPO(
        "MlpPolicy", worlds, n_steps=64, batch_size=1024, gamma=0.98, device="cpu", policy_kwargs=settings, verbose=1
    )
    learner.learn(DECISIONS)
    learner.save(FILE)
elif FILE.exists():
    learner = PPO.load(FILE, device="cpu")
else:
    raise FileNotFoundError(f"no {FILE.name}: train first, python {Path(__file__).name}")


def act(seen):
    """Return actions (worlds, 12) for observations (worlds, 63)."""
    return learner.predict(seen)[0]
