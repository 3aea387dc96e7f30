"""A stand-in for a policy of one's own: writes policy.onnx, 48 observations to 12 actions, with random weights."""

import warnings
from pathlib import Path

import torch

warnings.simplefilter("ignore", DeprecationWarning)  # torch's newer exporter needs one more package
torch.manual_seed(0)
network = torch.nn.Sequential(torch.nn.Linear(48, 16), torch.nn.ELU(), torch.nn.Linear(16, 12))
axes = {"seen": {0: "worlds"}, "actions": {0: "worlds"}}
file = Path(__file__).with_name("policy.onnx")
torch.onnx.export(
    network, (torch.zeros(1, 48),), str(file), input_names=["seen"], output_names=["actions"], dynamic_axes=axes,
    dynamo=False,
)  # fmt: skip
