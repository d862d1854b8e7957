"""The page of every group, option and key of the configuration, from the comments in configs/."""

import functools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from suspnet.cli import program  # makes our resolvers and tables known to Hydra
from suspnet.cli.config_files import TABLES, read_comments
from suspnet.cli.reference import Group, Key, Keys, Reference, text

CONFIGS = Path(program.CONFIGS)
PROGRAMS = {
    "train": "`python train.py`, `suspnet-train`",
    "evaluate": "`python evaluate.py`, `suspnet-evaluate`",
    "simulate": "`suspnet simulate`, `suspnet-simulate`",
    "monitor": "`suspnet monitor`, `suspnet-monitor`",
    "replay": "`suspnet replay`, `suspnet-replay`",
    "serve": "`suspnet serve`, `suspnet-serve`",
}
WITH_PROTOCOL = ("group", "groups", "tuned")
"""Keys beside `protocol` that the options of that group set."""
OF_OTHER_GROUPS = ("experiment",)
"""Groups whose options set keys of other groups only."""
NOT_COMPARED = ("name", "source", "limits")
"""Names of keys that differ between options anyhow, or are explained as a whole."""
HEAD = """# Configuration

This page lists every key of the programs that take `KEY=VALUE`, with its default, unit, range and
meaning. `--help` prints the same for what is chosen on the command line, and `--cfg job` prints the
values alone:

    python train.py model=svr data=trips --help
    python evaluate.py study=maintenance --help

Choose a group as `GROUP=OPTION`, and set a single value as `KEY=VALUE`; see {doc}`usage </usage>`.
A unit comes first, a range after it. A number without a unit is dimensionless. No number may be
infinite or beyond 1e20. A default that follows from another key (`${...}` in the file) is the value
that follows from the defaults."""
LAUNCHER = CONFIGS / "hydra" / "launcher" / "slurm.yaml"


@functools.cache
def page() -> str:
    """Return the page with the tables of all programs and groups as Markdown.

    Raises
    ------
    LookupError
        If a key, a group or an option has no comment that says what it is.
    """
    HydraConfig.instance().cfg = None  # that of a program that ran in this process is none of ours
    with initialize_config_dir(version_base="1.3", config_dir=str(CONFIGS)):
        configs = {name: composed(name) for name in PROGRAMS}
        found = {}
        for name in PROGRAMS:
            new = [group for group in configs[name].groups() if group.name not in found]
            found |= {
                group.name: (group, options) for group, options in composed_options(name, new)
            }
        parts = [
            f"## Keys of {title}\n\n{key_table(of_program(configs[name]))}"
            for name, title in PROGRAMS.items()
        ]
        parts += [of_group(*one) for one in found.values()]
    return "\n\n".join([HEAD, *parts, of_launcher()]) + "\n"


def composed(name: str, *overrides: str) -> Reference:
    """Return what a program's configuration can be told."""
    return Reference(compose(name, list(overrides), return_hydra_config=True))


def composed_options(
    program: str, of: Sequence[Group]
) -> Iterator[tuple[Group, dict[str, Reference]]]:
    """Yield groups, each with a configuration for each of its options.

    One configuration has an option of every group but the protocol, which tunes the others.
    """
    apart = [group for group in of if group.name == "protocol"]
    for together in (apart, [one for one in of if one not in apart]):
        orders = {group.name: in_order(group) for group in together if sets_own_keys(group)}
        configs = [
            composed(program, *(f"{name}={one[k]}" for name, one in orders.items() if k < len(one)))
            for k in range(max(map(len, orders.values()), default=0))
        ]
        for group in together:
            yield group, dict(zip(orders.get(group.name, ()), configs, strict=False))


def sets_own_keys(group: Group) -> bool:
    """Return whether the options of a group set keys of their own."""
    return group.name not in OF_OTHER_GROUPS


def of_program(config: Reference) -> list[Key]:
    """Return the keys of a program as it is that no option of a group sets."""
    chosen = {group.name for group in config.groups() if group.chosen is not None}
    with_protocol = WITH_PROTOCOL if "protocol" in chosen else ()
    return [key for key in config.keys() if first(key) not in {*chosen, *with_protocol}]


def of_group(group: Group, configs: Mapping[str, Reference]) -> str:
    """Return a section on a group: its options, their keys, and what differs between them."""
    title = f"## Group `{group.name}`: {said(group.phrase, group.name)}"
    if not sets_own_keys(group):
        changed = {name: f"`{' '.join(sets(group.name, name))}`" for name in group.options}
        return f"{title}\n\n{option_table(group, {'sets': changed})}"
    found = {name: of_option(group.name, name, config) for name, config in configs.items()}
    parts = [title, option_table(group, sources(group, configs))]
    alike: dict[str, list[str]] = {}
    for name, rows in found.items():
        if not rows:
            continue
        kind = OmegaConf.select(configs[name].config, f"{group.name}.kind")
        leader = name
        for other in alike:
            shown = {told(key) for key in found[other]}
            same = OmegaConf.select(configs[other].config, f"{group.name}.kind") == kind
            if group.name != "study" and (same or {told(key) for key in rows} <= shown):
                leader, rows = other, [key for key in rows if told(key) not in shown]
                break
        alike.setdefault(leader, []).append(name)
        if rows:
            parts.append(f"### `{group.name}={name}`\n\n{key_table(rows)}")
    for names in alike.values():
        if rows := differing({name: (configs[name], found[name]) for name in names}):
            heading = f"### What differs between options of `{group.name}`"
            parts.append(f"{heading}\n\n{table(rows, ['key', *names])}")
    return "\n\n".join(parts)


def of_option(group: str, name: str, config: Reference) -> list[Key]:
    """Return the keys that an option of a group sets."""
    own = {"protocol": ("protocol", *WITH_PROTOCOL)}.get(group, (group,))
    if group == "study":  # they are on the keys of other groups as well
        file = CONFIGS / group / f"{name}.yaml"
        own = tuple(path[0] for path in read_comments(file).above)
    return [key for key in config.keys() if first(key) in own]


def in_order(group: Group) -> list[str]:
    """Return the options of a group: the default first, those that change others last."""

    def changes_another(name: str) -> bool:
        file = CONFIGS / group.name / f"{name}.yaml"
        return file.is_file() and "defaults" in plain(file)

    return sorted(group.options, key=lambda name: (name != group.chosen, changes_another(name)))


def first(key: Key) -> str:
    """Return the first of the names that lead to a key."""
    return key.name.partition(".")[0]


def told(key: Key) -> tuple[str, str]:
    """Return a key's name and sentence."""
    return key.name, key.sentence


def said(words: str, name: str) -> str:
    """Return words; raise LookupError if there are none."""
    if not words:
        raise LookupError(f"no comment in configs/ says what `{name}` is")
    return words


def sets(group: str, name: str) -> list[str]:
    """Return what an option sets, as on the command line."""
    if group in TABLES:
        return list(changes(plain(CONFIGS / TABLES[group][0])[name]))
    content = plain(CONFIGS / group / f"{name}.yaml")
    chosen = [one for one in content.pop("defaults", []) if isinstance(one, dict)]
    found = [f"{key.split('/')[-1]}={option}" for one in chosen for key, option in one.items()]
    swept = content.pop("hydra", {}).get("sweeper", {}).get("params", {})
    return [*found, *changes(content), *(f"{key}={value}" for key, value in swept.items())]


def plain(file: Path) -> Any:
    """Return what a file holds."""
    return OmegaConf.to_container(OmegaConf.load(file), resolve=False)


def sources(group: Group, configs: Mapping[str, Reference]) -> dict[str, dict[str, str]]:
    """Return the source that each option names, as a column; no column if none does."""
    found = {
        name: source
        for name, config in configs.items()
        if (source := OmegaConf.select(config.config, f"{group.name}.source"))
    }
    return {"source": found} if found else {}


def differing(options: Mapping[str, tuple[Reference, list[Key]]]) -> list[list[str]]:
    """Return a row for each value that differs between options, a column for each of them."""
    columns = [flat(config, rows) for config, rows in options.values()]
    names = dict.fromkeys(name for column in columns for name in column)
    rows = [[name, *(column.get(name, "") for column in columns)] for name in names]
    return [
        [f"`{row[0]}`", *map(code, row[1:])]
        for row in rows
        if len(set(row[1:])) > 1 and not set(row[0].split(".")) & set(NOT_COMPARED)
    ]


def flat(config: Reference, rows: Sequence[Key]) -> dict[str, str]:
    """Return values by keys, those of mappings one by one."""
    found = {}
    for key in rows:
        value = OmegaConf.select(config.config, key.name) if key.value.startswith("{") else None
        if value is None:
            found[key.name] = key.value
        else:
            parts = changes(OmegaConf.to_container(value, resolve=False), (key.name,))
            found |= {name: one for name, _, one in (part.partition("=") for part in parts)}
    return found


def option_table(group: Group, columns: Mapping[str, Mapping[str, str]]) -> str:
    """Return the options of a group with their phrases, and further columns by their headings."""
    rows = [
        [
            f"`{name}`" + " (default)" * (name == group.chosen),
            cell(said(group.options[name], f"{group.name}={name}")),
            *(cell(column.get(name, "")) for column in columns.values()),
        ]
        for name in in_order(group)
    ]
    return table(rows, ["option", "what it is", *columns])


def key_table(rows: Sequence[Key]) -> str:
    """Return keys with default, unit and range, and meaning."""
    return table(
        [
            [f"`{key.name}`", code(key.value), cell(key.limits), cell(said(key.meaning, key.name))]
            for key in rows
        ],
        ["key", "default", "unit and range", "meaning"],
    )


def of_launcher() -> str:
    """Return a section on the settings of jobs on Slurm."""
    sentences = read_comments(LAUNCHER).above
    rows = [
        Key(f"hydra.launcher.{name}", text(value), sentences.get((name,), ""))
        for name, value in plain(LAUNCHER).items()
        if name != "defaults"
    ]
    return f"## `hydra/launcher=slurm`: a Slurm job for each run\n\n{key_table(rows)}"


def table(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Return a table as Markdown, its columns as wide as they come."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(words: str) -> str:
    """Return words for a cell of a table."""
    return words.replace("|", "\\|")


def code(words: str) -> str:
    """Return a value for a cell of a table; nothing for none."""
    return f"`{cell(words)}`" if words else ""


def changes(entry: Any, path: Keys = ()) -> Iterator[str]:
    """Yield the values of a mapping as KEY=VALUE."""
    if not isinstance(entry, dict):
        yield f"{'.'.join(path)}={text(entry)}"
        return
    for name, one in entry.items():
        yield from changes(one, (*path, str(name)))
