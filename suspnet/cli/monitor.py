"""Estimate from live frames and store the results: suspnet-monitor run=RUN suspensions=DIR."""

import logging
import sys
from collections import Counter
from contextlib import closing, nullcontext
from functools import partial
from pathlib import Path

from omegaconf import DictConfig

from suspnet.cli import program
from suspnet.cli.kinds import build, named_runs
from suspnet.depot.live.journal import Journal
from suspnet.depot.live.monitor import Monitor
from suspnet.depot.live.notifier import Notifier, read_rules
from suspnet.depot.live.results import report
from suspnet.depot.live.suspension import read_suspensions
from suspnet.estimation.checkpoint import load_model
from suspnet.trains.history import History

log = logging.getLogger(__name__)


@program.task
def main(config: DictConfig) -> None:
    """Load models and manifests, and read the source until it ends."""
    for key in ("run", "suspensions", "store"):
        if config.get(key, None) is None:
            raise ValueError(f"`{key}` is missing: suspnet-monitor --help says what it is")
    for handler in logging.getLogger().handlers:  # standard output is for results
        if isinstance(handler, logging.StreamHandler) and handler.stream is sys.stdout:
            handler.setStream(sys.stderr)
    program.n_threads(config.threads)
    program.save_config(config, program.run_folder())
    models = [load_model(run, config.device) for run in named_runs(config.run)]
    settings = build(config, "monitor")
    live = build(config, "live")
    suspensions = read_suspensions(Path(config.suspensions), models, settings, live)
    source = build(config, "source")
    rules = None if config.notify is None else read_rules(Path(config.notify))
    with (
        History(config.store) as store,
        Journal(Path(config.journal)) as journal,
        closing(source),
        nullcontext() if rules is None else closing(Notifier(store, rules)) as notifier,
    ):
        store_result = partial(report, store, settings)
        monitor = Monitor(suspensions, source, journal, store_result, live.idle_s)
        n_frames = monitor.resume()
        log.info("%d suspensions; %d frames from %s", len(suspensions), n_frames, config.journal)
        if notifier is not None:
            notifier.start()
        try:
            monitor.run()
        finally:
            log.info("frames: %s", words(monitor.counts + source.counts))


def words(counts: Counter[str]) -> str:
    """Return counts as text, the largest first."""
    return ", ".join(f"{n} {name}" for name, n in counts.most_common()) or "none"
