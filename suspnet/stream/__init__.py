"""Live samples: frames, their order, and recordings that grow while a train runs."""

from suspnet.stream.assembler import Assembler
from suspnet.stream.frames import Frame, FrameError, decode, encode
from suspnet.stream.running import Running
from suspnet.stream.sections import Sections
from suspnet.stream.state import StateError

__all__ = [
    "Assembler",
    "Frame",
    "FrameError",
    "Running",
    "Sections",
    "StateError",
    "decode",
    "encode",
]
