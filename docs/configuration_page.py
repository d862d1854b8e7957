"""The page of every key of the configuration: the files of configs/ as they are."""

from collections.abc import Iterator
from pathlib import Path

from suspnet.cli.config_files import CONFIGS, TABLES, phrase

PROGRAMS = ("train", "evaluate", "simulate", "monitor", "replay", "serve")
HEAD = """# Configuration

This page has every file of the programs that take `KEY=VALUE`: each key with its default and, above
it, its meaning with unit and range in brackets. `--help` prints the files that are chosen on the
command line, and `--cfg job` the values alone:

    python train.py model=svr data=trips --help
    python evaluate.py study=maintenance --help

Choose a group as `GROUP=OPTION`, and set a single value as `KEY=VALUE`; see {doc}`usage </usage>`.
A unit comes first, a range after it. A number without a unit is dimensionless. No number may be
infinite or beyond 1e20. A default `${...}` follows from another key."""


def page() -> str:
    """Return the page of all programs and groups as Markdown.

    Raises
    ------
    LookupError
        If a file has no comment that says what it is.
    """
    parts = [HEAD]
    for name in PROGRAMS:
        parts.append(f"## `suspnet {name}`\n\n{block(Path(CONFIGS) / f'{name}.yaml')}")
    for file in sorted((Path(CONFIGS) / "base").glob("*.yaml")):
        parts.append(f"## Keys that programs share: `{file.stem}`\n\n{block(file)}")
    for group, (file_name, _) in TABLES.items():
        parts.append(f"## Group `{group}`\n\n{block(Path(CONFIGS) / file_name)}")
    for folder in groups():
        parts.append(f"## Group `{folder.relative_to(CONFIGS)}`")
        for file in sorted(folder.glob("*.yaml")):
            if not phrase(file):
                raise LookupError(f"no comment in {file} says what it is")
            parts.append(f"### `{folder.relative_to(CONFIGS)}={file.stem}`\n\n{block(file)}")
    return "\n\n".join(parts) + "\n"


def groups() -> Iterator[Path]:
    """Yield the folder of each group."""
    for folder in sorted(path for path in Path(CONFIGS).rglob("*") if path.is_dir()):
        if folder.name not in ("base", "hydra", "__pycache__"):
            yield folder


def block(file: Path) -> str:
    """Return a file as a block of code."""
    return f"```yaml\n{file.read_text(encoding='utf-8').rstrip()}\n```"
