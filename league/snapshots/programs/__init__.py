"""Policies that are programs of others: ONNX and TorchScript files and Python functions, as players of a league."""
