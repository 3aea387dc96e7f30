"""Streams of JAX stay known to Warp while any of their wrappers is in use."""

import pytest
import torch

warp = pytest.importorskip("warp")
keep_external_streams = pytest.importorskip("arenas.physics.warp_streams").keep_external_streams


@pytest.mark.gpu
def test_a_stream_can_be_captured_after_an_older_wrapper_of_it_was_removed():
    keep_external_streams()
    device, stream = warp.get_device("cuda:0"), torch.cuda.Stream()
    older = warp.Stream(device, cuda_stream=stream.cuda_stream)
    newer = warp.Stream(device, cuda_stream=stream.cuda_stream)
    array = warp.zeros(4, dtype=float, device=device)
    del older  # without the mend: "unknown stream"
    with warp.ScopedStream(newer, sync_enter=False), warp.ScopedCapture() as capture:
        array.fill_(3.0)
    with warp.ScopedStream(newer):
        warp.capture_launch(capture.graph)
    assert array.numpy().tolist() == [3.0] * 4


def test_it_is_done_once():
    keep_external_streams()
    removal = warp.Stream.__del__
    keep_external_streams()
    assert warp.Stream.__del__ is removal
