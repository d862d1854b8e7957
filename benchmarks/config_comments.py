"""The comments in configs/, from the sentences that settings are declared with."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from suspnet.cli.commission_fleet import HealthySettings
from suspnet.cli.config_files import CONFIGS, TABLES, Keys, read_comments
from suspnet.cli.kinds import KINDS, class_of
from suspnet.cli.program import THREADS
from suspnet.cli.reference import filled
from suspnet.cli.serve import ServeSettings
from suspnet.cli.simulate import WORKERS
from suspnet.curves.components import CurveFeatures
from suspnet.curves.extraction import PeakFeatures
from suspnet.depot.live.replay import Replay
from suspnet.ground.settings import Declared, settings_of
from suspnet.trains.simulation.fleet import Trains
from suspnet.trains.simulation.signals import Sensor

OF_PROGRAMS: dict[str, list[Declared]] = {
    "replay": [*settings_of(Replay).values()],
    "simulate": [*settings_of(Trains).values(), WORKERS],
    "serve": [*settings_of(ServeSettings).values()],
    "train": [*settings_of(HealthySettings).values(), THREADS],
    "evaluate": [THREADS],
}
"""Settings of programs that are no object's."""


def declaring() -> Iterator[tuple[str, str, Keys, Any]]:
    """Yield place, kind, path and class of everything that declares settings."""
    for place, kinds in KINDS.items():
        for kind in kinds:
            if place != "generator" or kind == "vertical_vehicle":  # the others hand theirs on
                yield place, kind, (), class_of(place, kind)
    yield "protocol", "", ("features",), PeakFeatures
    yield "protocol", "", ("curve",), CurveFeatures
    yield "fleet", "", ("sensors", "axle_box"), Sensor


def declared() -> dict[tuple[str, str, Keys], str]:
    """Return the sentence on each setting, by place, kind and key of its object."""
    return {
        (place, kind, (*path, name)): one.text
        for place, kind, path, class_ in declaring()
        for name, one in settings_of(class_).items()
    }


def commented(file: Path) -> str:
    """Return the text of a file in configs/, with the declared sentences above their keys.

    A key without a comment, whose sentence another file has, remains so.
    """
    sentences, comments = declared(), read_comments(file)
    programs = OF_PROGRAMS if file.parent == Path(CONFIGS) else {}
    of_program = {(one.name,): one.text for one in programs.get(file.stem, ())}
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    for keys in reversed(comments.above):  # from the last line on, so that numbers of lines hold
        known = [sentences[one] for one in objects_of(file, keys) if one in sentences]
        sentence = known[-1] if known else of_program.get(keys)
        if sentence is not None:
            end, column = comments.lines[keys]
            start = end
            while lines[start - 1].startswith(" " * column + "#"):
                start -= 1
            lines[start:end] = [f"{line}\n" for line in wrapped(sentence, " " * column + "# ")]
    return "".join(lines)


def objects_of(file: Path, keys: Keys) -> Iterator[tuple[str, Any, Keys]]:
    """Yield each object that a key of a file belongs to: its place, its kind, the key below it."""
    comments, tables = read_comments(file), {name: group for group, (name, _) in TABLES.items()}
    folder = file.parent.name
    group = file.stem if folder == "base" else tables.get(file.name, folder)
    # an entry of a table has a name, after which come the keys
    before = () if comments.is_global else (group,)
    path = (*before, *keys[file.name in tables :])
    for n, place in enumerate(path[:-1]):
        if place in KINDS:
            kind = comments.kinds.get(path[len(before) : n + 1], "")
            yield place, kind, path[n + 1 :]


def wrapped(sentence: str, indent: str) -> list[str]:
    """Return a sentence as lines; unit and range get a line of their own rather than break."""
    whole = filled(sentence, indent)
    meaning, _, rule = sentence.rpartition(" [")
    if f"[{rule}" in whole[-1]:
        return whole
    return filled(meaning, indent) + filled(f"[{rule}", indent)
