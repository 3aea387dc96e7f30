"""Registration of JAX's CUDA streams with Warp."""

import warp


def keep_external_streams() -> None:
    """Let Warp remember the streams of JAX that it has seen.

    Warp 1.18 wraps JAX's stream anew for every call, and forgets the stream as soon as one of the wrappers is removed,
    even if another one is in use. Where Python removes a wrapper of an earlier call late, a step that is being captured
    ends with "unknown stream". JAX's streams live as long as the process, so none has to be forgotten.
    """
    Stream = warp.Stream
    if getattr(Stream.__del__, "keeps_external", False):
        return
    forget = Stream.__del__

    def remove(self: warp.Stream) -> None:
        if getattr(self, "owner", False):
            forget(self)

    remove.keeps_external = True  # pyright: ignore[reportFunctionMemberAccess]
    Stream.__del__ = remove
