"""Devices that learners compute on: CUDA graphs of an update, and processes that share one update."""
