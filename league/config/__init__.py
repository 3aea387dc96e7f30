"""The whole experiment as frozen dataclasses and as a commented file. Loads neither torch, jax nor mujoco."""
