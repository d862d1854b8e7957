"""`--help`: each key has a sentence with unit and range, as its setting is declared."""

import re
import sys
from pathlib import Path

import pytest
from cli_runner import typed
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from suspnet.cli import check, init, options, train
from suspnet.cli.config_files import CONFIGS, TABLES
from suspnet.cli.program import n_threads
from suspnet.trains.simulation.true_vehicle import scattered

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "docs")]
import configuration_page  # noqa: E402
from config_comments import COLUMNS, commented, read_comments  # noqa: E402

LONGEST = 260
"""Number of characters of a sentence beyond which nobody reads it."""
FILES = sorted(Path(CONFIGS).rglob("*.yaml"))


def described(name, *choices):
    """Return the help of a program, and its keys without those of Hydra."""
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(name, list(choices), return_hydra_config=True)
        text = config.hydra.help.template.replace("$$", "$")
    return text, OmegaConf.to_container(OmegaConf.masked_copy(config, [*config][1:]))


def test_comments_are_sentences_with_unit_and_range_as_declared():
    for file in FILES:
        check_comments(file)


def check_comments(file):
    is_table = file.name in {name for name, _ in TABLES.values()}
    for keys, sentence in read_comments(file).above.items():
        if keys[0] != "hydra" and (keys[1:] or not is_table):
            assert re.fullmatch(r"[A-Z\d].* \[[^\[\]]+\]", sentence), (keys, sentence)
            assert len(sentence) <= LONGEST, (keys, sentence)
    text = file.read_text(encoding="utf-8")
    assert commented(file) == text, f"{file}: python benchmarks/docs_tables.py"
    assert max(map(len, text.splitlines())) <= COLUMNS


def leaves(node, path=()):
    if not isinstance(node, dict) or not node:
        yield path
        return
    for key, value in node.items():
        yield from leaves(value, (*path, str(key)))


@pytest.mark.parametrize(
    ("program", "choice"),
    [
        *(("train", choice) for choice in ("model=curve_fit", "model=msvr_table5", "data=trips")),
        *(("train", choice) for choice in ("search=widened", "experiment=trips")),
        *(("evaluate", "study=maintenance"), ("simulate", "scenario=random")),
        *(("monitor", "source=mqtt"), ("serve", "port=1")),
    ],
    ids=lambda value: value,
)
def test_help_has_a_comment_on_every_key_and_a_phrase_on_every_option(program, choice):
    text, keys = described(program, choice)
    explained = set(re.findall(r"\[[^\[\]]+\]\n *([\w.]+):", text))
    group, _, option = choice.partition("=")
    if (Path(CONFIGS) / group).is_dir() or group in TABLES:
        assert re.search(rf"^{group}:\n(    .*\n)*  \* {option} +\S.*\S", text, re.MULTILINE)
    for path in leaves(keys):
        is_explained = any(re.sub(r"\W", "_", key) in explained for key in path)
        assert is_explained or path[-1] == "kind", path


def test_help_is_of_what_is_chosen_on_the_command_line():
    done = typed(train, "model=svr", "model.C=7", "--help", cwd=".")
    assert done.returncode == 0
    assert done.stdout.startswith("suspnet: ")
    assert "  * svr  " in done.stdout
    assert "# Stopping tolerance of libsvm [above 0]\ntol: 1.0e-3\n" in done.stdout
    assert "C: ${tuned.${group}.svr.C}" in done.stdout
    assert "landmarks" not in done.stdout
    assert "\nhydra:" not in done.stdout


def test_vehicle_of_the_users_is_shown(tmp_path):
    (tmp_path / "vehicle").mkdir()
    text = (Path(CONFIGS) / "vehicle" / "ice3.yaml").read_text()
    mine = "# Ours, $1 each\n" + re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)
    (tmp_path / "vehicle" / "mine.yaml").write_text(mine)
    done = typed(train, "--config-dir", tmp_path, "vehicle=mine", "--help", cwd=".")
    assert re.search(r"\* mine +Ours, \$1 each", done.stdout)
    assert "bogie_mass_kg: 1750" in done.stdout


def test_page_of_settings_has_a_section_for_every_group_and_every_file():
    page = configuration_page.page()
    groups = {path.name for path in Path(CONFIGS).iterdir() if path.is_dir()} | {*TABLES}
    headings = set(re.findall(r"^## Group `([\w/]+)`$", page, re.MULTILINE))
    assert headings == groups - {"base", "hydra"} | {"hydra/launcher"}
    assert all(file.read_text().rstrip() in page for file in FILES)


def test_ranges_of_the_programs_are_those_of_their_checks(quarter_car):
    shown = {
        name: read_comments(Path(CONFIGS) / f"{name}.yaml").above for name in ("train", "simulate")
    }
    assert shown["train"]["threads",].endswith("[whole number; 1 to 1024; or null]")
    for wrong in (0, 1025, 1.5):
        with pytest.raises((ValueError, TypeError), match="`threads` must be"):
            n_threads(wrong)
    assert shown["simulate"]["scatter",].endswith("[0 to 5]")
    for wrong in (-0.1, 5.1):
        with pytest.raises(ValueError, match="`scatter` must be"):
            scattered(quarter_car, wrong, 0)


@pytest.mark.parametrize("module", [check, init], ids=lambda one: one.__name__)
def test_options_of_plain_programs_tell_unit_or_range(module):
    for action in options.PARSERS[module.__name__.rpartition(".")[2]]()._actions:
        if action.dest != "help":
            assert re.fullmatch(r".* \[[^\[\]]+\]", action.help), action
    assert "[" in typed(module, "--help", cwd=".").stdout
