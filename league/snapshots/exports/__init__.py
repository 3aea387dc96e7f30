"""Frozen policies taken out of a league: as ONNX, TorchScript and NumPy, with a description of what goes in and out."""
