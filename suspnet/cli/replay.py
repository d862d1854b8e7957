"""Replay recorded trips as frames of live samples: suspnet-replay trips=DIR [KEY=VALUE ...]."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from omegaconf import DictConfig

from suspnet.cli import program
from suspnet.cli.kinds import build
from suspnet.depot.live.replay import Pace, Replay
from suspnet.depot.live.sinks import Sink
from suspnet.ground.progress import bar
from suspnet.ground.wording import count


@program.task
def main(config: DictConfig) -> None:
    """Send the frames of all trips of a folder; report counts on standard error."""
    start_s = time.monotonic()
    pace = Pace(config.times)
    replay = Replay(Path(config.trips), config.frame_s, config.start, config.zone)
    sink: Sink = build(config, "sink")
    sink.open()
    n_frames = n_samples = 0
    frames = replay.frames()
    if config.progress:
        frames = bar("frames", items=frames, unit="frame")
    for frame in frames:
        pace.wait(frame)
        sink.send(frame)
        n_frames, n_samples = n_frames + 1, n_samples + len(frame.samples)
    sink.close()
    words = (
        f"{count(n_frames, 'frame')} with {n_samples} samples of {count(replay.n_trips, 'trip')} "
        f"of {count(replay.n_suspensions, 'suspension')} in {time.monotonic() - start_s:.1f} s"
    )
    for reason, n in sink.counts.items():
        words += f"; {reason}: {n}"
    print(words, file=sys.stderr)  # standard output may hold the frames
    if replay.problems:
        raise ValueError(f"{len(replay.problems)} trips are missing or incomplete, see above")
