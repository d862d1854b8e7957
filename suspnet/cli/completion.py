"""Completion of the command line in bash and zsh: a script of plain words, printed once.

It holds the programs, their options, and of programs with a configuration the groups with their
options and the settings of the first two levels. So a press of the key starts no Python.
"""

from __future__ import annotations

from argparse import ArgumentParser, _SubParsersAction
from collections.abc import Iterable, Iterator
from pathlib import Path
from string import Template
from typing import Any

import yaml

from suspnet.cli.command import COMPLETION, MEANINGS, SHELLS
from suspnet.cli.config_files import CONFIGS, TABLES
from suspnet.cli.options import PARSERS
from suspnet.trips.folder_manifests import SAYABLE

HYDRA_OPTIONS = ("--help", "--cfg", "--config-dir", "--multirun", "--plugin")
"""Options of the programs with a configuration that are worth a completion."""
BASH_SCRIPT = Template("""\
_suspnet() {
  local line word rest name words cut
  line="$${COMP_LINE:0:$$COMP_POINT}"
  word="$${line##*[[:space:]]}"
  rest="$${line#*[[:space:]]}"
  case "$$rest" in *[[:space:]]*) name="$${rest%%[[:space:]]*}" ;; *) name="" ;; esac
  case "$$name" in
$bash_cases
    "") words="$programs" ;;
  esac
  COMPREPLY=($$(compgen -W "$$words" -- "$$word"))
  if [ -n "$$name" ] && { [ -z "$${COMPREPLY[*]}" ] || [ "$${COMPREPLY[*]}" = "$$word" ]; }; then
    compopt -o filenames
    local IFS=$$'\n'  # names may have blanks
    COMPREPLY=($$(compgen -f -- "$${word#*=}"))
    return
  fi
  case "$$word" in  # bash takes what follows the = for a word of its own
    *=*) cut="$${word%%=*}="; COMPREPLY=("$${COMPREPLY[@]#"$$cut"}") ;;
  esac
  case "$${COMPREPLY[*]}" in *=) compopt -o nospace ;; esac
}
complete -F _suspnet suspnet
""")
ZSH_SCRIPT = Template("""\
(( $$+functions[compdef] )) || { autoload -U compinit && compinit -i; }
_suspnet() {
  local -a known
  if (( CURRENT == 2 )); then
    compadd -- $programs
    return
  fi
  case "$$words[2]" in
$zsh_cases
  esac
  [[ "$$PREFIX" == *= ]] || compadd -S "" -- $${(M)known:#*=}
  compadd -- $${known:#*=}
  if (( compstate[nmatches] == 0 )); then
    compset -P "*="
    _files
  fi
}
compdef _suspnet suspnet
""")


def script(shell: str) -> str:
    """Return the script that a shell reads: ``source <(suspnet completion bash)``."""
    words = {name: " ".join(sorted(set(_words(name)))) for name in MEANINGS}
    words[COMPLETION] = " ".join(SHELLS)
    template = BASH_SCRIPT if shell == "bash" else ZSH_SCRIPT
    return template.substitute(
        programs=" ".join([*words, "--help", "--version"]),
        bash_cases="\n".join(f'    {name}) words="{one}" ;;' for name, one in words.items()),
        zsh_cases="\n".join(f"    {name}) known=({one}) ;;" for name, one in words.items()),
    )


def _words(name: str) -> Iterator[str]:
    """Yield what may follow a program's name."""
    if name in PARSERS:
        yield from _options(PARSERS[name]())
        yield from (f"{key}=" for key in SAYABLE if name == "init")
        return
    yield from HYDRA_OPTIONS
    content = _read(Path(CONFIGS) / f"{name}.yaml")
    for entry in content.pop("defaults", []):
        if isinstance(entry, dict):
            for group, chosen in entry.items():
                yield from _group(str(group).strip("/"), chosen)
        elif isinstance(entry, str) and entry.startswith("base/"):
            yield from _keys(_read(Path(CONFIGS) / f"{entry.partition('@')[0]}.yaml"))
    yield from _keys(content)


def _options(parser: ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, _SubParsersAction):
            yield from action.choices
            for one in action.choices.values():
                yield from _options(one)
        yield from (one for one in action.option_strings if one.startswith("--"))


def _group(group: str, chosen: Any) -> Iterator[str]:
    """Yield the options of a group, and the settings of all of them."""
    files = sorted((Path(CONFIGS) / group).glob("*.yaml"))
    yield from (f"{group}={file.stem}" for file in files)
    if group in TABLES:
        yield from (f"{group}={one}" for one in _read(Path(CONFIGS) / TABLES[group][0]))
    if chosen is not None:
        for file in files:
            yield from (f"{group}.{key}" for key in _keys(_read(file)))


def _keys(content: dict[str, Any]) -> Iterable[str]:
    """Yield the settings of the first level, and those of the second as one with a dot."""
    for key, value in content.items():
        if key in ("hydra", "defaults", "kind"):
            continue
        if isinstance(value, dict):
            yield from (f"{key}.{one}=" for one, of in value.items() if not isinstance(of, dict))
        else:
            yield f"{key}="


def _read(file: Path) -> dict[str, Any]:
    content = yaml.safe_load(file.read_text(encoding="utf-8"))
    return content if isinstance(content, dict) else {}
