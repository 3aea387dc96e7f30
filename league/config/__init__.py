"""The whole experiment as frozen dataclasses, and as a commented file: loads neither torch, jax nor mujoco."""
