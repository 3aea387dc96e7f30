"""Scenes: MuJoCo models with robots and props, start poses, domain randomisation."""
