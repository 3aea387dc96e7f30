"""Exports to other tools: Foxglove, TensorBoard, Weights & Biases."""
