"""Robots from files: MJCF or URDF, read by MuJoCo and fitted to our scenes, with settings that a person edits."""
