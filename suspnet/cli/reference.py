"""The `--help` of a configuration: its groups, options and keys with their meaning."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from suspnet.cli.config_files import (
    CONFIGS,
    TABLES,
    Comments,
    Keys,
    as_written,
    phrase,
    read_comments,
)
from suspnet.cli.kinds import KINDS, class_of
from suspnet.ground.settings import settings_of

COLUMNS, OPTION_COLUMNS, KEY_COLUMNS = 100, 22, 36
"""Width of the help, and of its first column for options and for keys, in characters."""
LONGEST_MAPPING = 60
"""Characters above which a mapping is shown by its keys only, or else as {...}."""
MOST_OPTIONS = 12
"""Options of a group above which the help only names them, unless one of them is chosen."""


@dataclass(frozen=True)
class Key:
    """A key of a composed configuration.

    `name` and `value` are written as on the command line, an interpolation as its number or text;
    `sentence` is the meaning with unit and range in brackets, "" if there is no comment.
    """

    name: str
    value: str
    sentence: str

    @property
    def meaning(self) -> str:
        """The sentence without unit and range."""
        return self.sentence.rpartition(" [")[0]

    @property
    def limits(self) -> str:
        """Unit and range."""
        return self.sentence.rpartition(" [")[2].removesuffix("]")


@dataclass(frozen=True)
class Group:
    """A group: the purpose in a phrase, and a phrase for each option."""

    name: str
    phrase: str
    options: Mapping[str, str]
    chosen: str | None


def register() -> None:
    """Register ${described:}, which gives the help, with OmegaConf."""
    OmegaConf.register_new_resolver("described", _described, replace=True)


class Reference:
    """Keys, groups and help of a configuration that was composed with Hydra's own block.

    Sentences come from the composed files, the last one first, then from the class of the object
    that a key belongs to. Use it before Hydra composes another configuration.
    """

    def __init__(self, config: DictConfig) -> None:
        self.config = config
        self._plain = as_written(config)
        self._plain.pop("hydra", None)
        sources = config.hydra.runtime.config_sources
        self._folders = [Path(source.path) for source in sources if source.schema == "file"]
        self._files = self._composed_files()

    def keys(self) -> list[Key]:
        """Return the keys; a mapping is one key if it has a sentence and none below it has one."""
        return [key for name, value in self._plain.items() for key in self._keys((name,), value)]

    def groups(self) -> list[Group]:
        """Return the groups that the configuration was composed from, and their options."""
        choices = self.config.hydra.runtime.choices
        return [
            Group(name, self._purpose(name), self._options(name), choices[name])
            for name in reversed(list(choices))
            if not name.startswith("hydra/")
        ]

    def help(self) -> str:
        """Return the text of a program's `--help`: groups and keys."""
        lines = ["Groups, chosen as GROUP=OPTION; * is chosen here:", ""]
        for group in self.groups():
            lines.append(f"{group.name}: {group.phrase}")
            if len(group.options) > MOST_OPTIONS and group.chosen is None:
                lines += filled(", ".join(group.options), " " * 4)
            else:
                for name, words in group.options.items():
                    mark = "*" if name == group.chosen else " "
                    lines += _two_columns(f"  {mark} {name}", words, OPTION_COLUMNS)
            lines.append("")
        lines += ["Keys, set as KEY=VALUE, with their values here, their units and ranges:"]
        section = None
        for key in self.keys():
            before, section = section, key.name.partition(".")[0] if "." in key.name else ""
            lines += [""] * (section != before)
            lines += _two_columns(f"  {key.name}={key.value}", key.sentence, KEY_COLUMNS)
        return "\n".join(lines) + "\n"

    def _composed_files(self) -> list[tuple[Keys, Comments]]:
        """Return package and comments of each composed file, the last one first."""
        hydra = self.config.hydra
        composed = (
            GlobalHydra.instance()
            .config_loader()
            .compute_defaults_list(hydra.job.config_name, list(hydra.overrides.task), RunMode.RUN)
        )
        comments = []
        for part in reversed(composed.defaults):
            package = tuple(part.package.split(".")) if part.package else ()
            files = [folder / f"{part.config_path}.yaml" for folder in self._folders]
            file = next((file for file in files if file.is_file()), None)
            if file is not None and package[:1] != ("hydra",):
                comments.append((package, read_comments(file)))
        return comments

    def _keys(self, path: Keys, value: Any) -> list[Key]:
        sentence = self._comment(path)
        if isinstance(value, dict) and value:
            below = [
                key
                for name, entry in value.items()
                if name != "kind"
                for key in self._keys((*path, str(name)), entry)
            ]
            sentence = sentence or ("" if any(k.sentence for k in below) else self._declared(path))
            if not sentence or any(key.sentence for key in below):
                return below
        return [Key(".".join(path), self._text(path, value), sentence or self._declared(path))]

    def _text(self, path: Keys, value: Any) -> str:
        """Return a value as text, an interpolation resolved unless it gives a mapping."""
        if isinstance(value, str) and "${" in value:
            try:
                resolved = OmegaConf.select(self.config, ".".join(path))
            except OmegaConfBaseException:  # refers to what is missing here
                return value
            if resolved is not None and not OmegaConf.is_dict(resolved):
                value = OmegaConf.to_object(resolved) if OmegaConf.is_list(resolved) else resolved
        return value if isinstance(value, str) else text(value)

    def _comment(self, path: Keys) -> str:
        """Return the sentence on a key in the composed files; "" if there is none."""
        for package, comments in self._files:
            n = len(package)
            if path[:n] == package and path[n:] in comments.above:
                return comments.above[path[n:]]
        if path[0] in TABLES:  # its options are entries of one file, with their names in front
            table = read_comments(Path(CONFIGS) / TABLES[path[0]][0]).above
            return next((table[keys] for keys in table if keys[1:] == path[1:]), "")
        return ""

    def _declared(self, path: Keys) -> str:
        """Return the sentence of an object's class on a key, which takes a second to import."""
        if len(path) < 2 or path[-2] not in KINDS:
            return ""
        kind = OmegaConf.select(self.config, ".".join(path[:-1])).get("kind") or ""
        class_ = class_of(path[-2], kind) if kind in KINDS[path[-2]] else None
        setting = settings_of(class_).get(path[-1]) if isinstance(class_, type) else None
        return "" if setting is None else setting.text

    def _purpose(self, group: str) -> str:
        """Return the purpose of a group: the comment behind it in a list of defaults."""
        names = [before + group for before in ("", "/", "override /", "override ")]
        phrases = (file.behind.get(("defaults", name)) for _, file in self._files for name in names)
        return next(filter(None, phrases), "")

    def _options(self, group: str) -> dict[str, str]:
        files = {f.stem: f for folder in self._folders for f in (folder / group).glob("*.yaml")}
        phrases = {name: phrase(file) for name, file in sorted(files.items())}
        if group in TABLES:
            table = read_comments(Path(CONFIGS) / TABLES[group][0])
            phrases |= {name: table.behind.get((name,), "") for name in table.names}
        return phrases


def text(value: Any) -> str:
    """Return a value as one line of YAML; a long mapping is shortened, see `LONGEST_MAPPING`."""
    flow = yaml.safe_dump(value, default_flow_style=True, width=10**6, sort_keys=False)
    words = [str(flow).removesuffix("...\n").strip()]
    if isinstance(value, dict):
        words += ["{" + ", ".join(f"{key}: ..." for key in value) + "}", "{...}"]
    return next((line for line in words if len(line) <= LONGEST_MAPPING), words[-1])


def _two_columns(left: str, right: str, width: int) -> list[str]:
    """Return two texts in columns; below each other if the left one is long."""
    words = left.lstrip(" ")
    first = filled(words, " " * (len(left) - len(words)))
    second = filled(right, " " * width)
    if second and len(first) == 1 and len(first[0]) < width - 1:
        return [first[0].ljust(width) + second[0].lstrip(), *second[1:]]
    return first + second


def filled(words: str, indent: str) -> list[str]:
    """Return words as lines of at most `COLUMNS` characters, each after an indent."""
    return textwrap.wrap(
        words,
        COLUMNS,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def _described(_root_: DictConfig) -> str:
    """Return the help as a Hydra template, in which each dollar sign is doubled."""
    return Reference(_root_).help().replace("$", "$$")
