"""Replay recorded trips as frames of live samples: suspnet-replay trips=DIR [KEY=VALUE ...]."""

import sys
import time
from pathlib import Path

from omegaconf import DictConfig

from suspnet.cli import program
from suspnet.depot.live.replay import FrameFiles, Replay
from suspnet.ground.progress import bar
from suspnet.ground.wording import count


@program.task
def main(config: DictConfig) -> None:
    """Write the frames of all trips of a folder into files; report counts on standard error."""
    start_s = time.monotonic()
    replay = Replay(Path(config.trips), config.frame_s, config.zone, config.times)
    frames = replay.frames()
    if config.progress:
        frames = bar("frames", items=frames, unit="frame")
    n_frames = n_samples = 0
    with FrameFiles(Path(config.out)) as files:
        for frame in frames:
            files.add(frame)
            n_frames, n_samples = n_frames + 1, n_samples + len(frame.samples)
    print(
        f"{count(n_frames, 'frame')} with {n_samples} samples of {count(replay.n_trips, 'trip')} "
        f"of {count(replay.n_suspensions, 'suspension')} in {time.monotonic() - start_s:.1f} s",
        file=sys.stderr,
    )
    if replay.problems:
        raise ValueError(f"{len(replay.problems)} trips are missing or incomplete, see above")
