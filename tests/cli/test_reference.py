"""`--help`: each key has a sentence with unit and range, as its setting is declared."""

import re
import sys
from pathlib import Path

import pytest
from cli_runner import typed
from hydra import compose, initialize_config_dir

from suspnet.cli import check, evaluate, init, options, simulate, train
from suspnet.cli.config_files import CONFIGS, SWITCHES, TABLES, phrase, read_comments
from suspnet.cli.program import n_threads
from suspnet.cli.reference import COLUMNS, Reference
from suspnet.trains.simulation.true_vehicle import scattered

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "docs")]
import configuration_page  # noqa: E402
from config_comments import commented  # noqa: E402

LONGEST = 260
"""Number of characters of a sentence beyond which nobody reads it."""
CHOSEN = [
    ("train", "model=curve_fit"),
    ("train", "model=msvr_table5"),
    ("train", "search=widened"),
    *(("train", f"experiment={name}") for name in ("trips", "fair")),
    ("evaluate", "study=identifiability"),
    ("simulate", "scenario=random"),
    ("replay", "sink=mqtt"),
]


def composed(name, *overrides):
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(name, overrides=list(overrides), return_hydra_config=True)
        return config, Reference(config).keys()


@pytest.mark.parametrize(("program", "choice"), CHOSEN, ids=lambda one: one)
def test_help_tells_every_key_its_value_unit_and_range(program, choice):
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(program, [choice], return_hydra_config=True)
        found = Reference(config)
    rows, text = found.keys(), found.help()
    words = " ".join(text.split())
    for key in rows:
        assert re.fullmatch(r"[A-Z\d].* \[[^\[\]]+\]", key.sentence), key
        assert len(key.sentence) <= LONGEST, key
        assert f"{key.name}={' '.join(key.value.split())} {key.sentence}" in words
    for line in text.splitlines():
        assert len(line) <= COLUMNS, line


@pytest.mark.parametrize("name", ["train", "evaluate", "simulate", "replay"])
def test_help_tells_every_group_and_option_of_the_program(name):
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        found = Reference(compose(name, return_hydra_config=True)).groups()
    assert {group.name for group in found} == {
        "train": {
            *("vehicle", "generator", "data", "protocol"),
            *("model", "search", "experiment", "reading"),
        },
        "evaluate": {"protocol", "study"},
        "simulate": {"vehicle", "generator", "scenario"},
        "replay": {"sink"},
    }[name]
    for group in found:
        assert group.phrase, group.name
        assert group.options
        for option, words in group.options.items():
            assert 3 < len(words) < 100, (group.name, option)


@pytest.mark.parametrize("module", [train, evaluate, simulate], ids=lambda one: one.__name__)
def test_programs_explain_their_keys(module):
    done = typed(module, "--help", cwd=".")
    assert done.returncode == 0
    assert "device=cpu                        Device of torch" in done.stdout
    assert done.stdout.startswith("suspnet: ")
    assert "--plugin FILE runs a Python file of yours first" in done.stdout
    assert max(map(len, done.stdout.splitlines())) <= COLUMNS


def test_help_is_of_what_is_chosen_on_the_command_line():
    done = typed(train, "model=svr", "model.C=7", "--help", cwd=".")
    assert "  * svr  " in done.stdout
    assert "libsvm" in done.stdout
    assert "model.C=7 " in done.stdout
    assert "landmarks" not in done.stdout.partition("Keys, set as")[2]


def test_vehicle_of_the_users_is_explained_by_its_class(tmp_path):
    (tmp_path / "vehicle").mkdir()
    text = (Path(CONFIGS) / "vehicle" / "ice3.yaml").read_text()
    mine = "# Ours, $1 each\n" + re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)
    (tmp_path / "vehicle" / "mine.yaml").write_text(mine)
    done = typed(train, "--config-dir", tmp_path, "vehicle=mine", "--help", cwd=".")
    assert re.search(r"\* mine +Ours, \$1 each", done.stdout)
    assert re.search(r"bogie_mass_kg=1750.0 +Mass of the bogie frame", done.stdout)


def test_key_without_comment_is_named():
    _, rows = composed("train", "+data.extra=1", "+more.x.y=2")
    missing = [key for key in rows if not key.sentence]
    assert [key.name for key in missing] == ["data.extra", "more.x.y"]
    with pytest.raises(LookupError, match=r"no comment in configs/ says what `data\.extra` is"):
        configuration_page.key_table(missing)


@pytest.mark.slow
def test_page_of_settings_has_a_section_for_every_group():
    groups = {path.name for path in Path(CONFIGS).iterdir() if path.is_dir()} | {*TABLES}
    headings = set(re.findall(r"^## Group `(\w+)`: ", configuration_page.page(), re.MULTILINE))
    assert headings == groups - {"base", "hydra"}


def test_comments_are_read_where_they_stand(tmp_path):
    file = tmp_path / "x.yaml"
    file.write_text(
        "# @package _global_\n"
        "# python train.py x=y\n"
        "# What it is.\n"
        "# And more.\n"
        "first: 1\n"
        "# apart\n"
        "\n"
        "second: '# none' # of the value\n"
        "# On the\n"
        "# third\n"
        "third: &it\n"
        "  # inside\n"
        "  a.b: {x: 1}\n"
        "# less indented\n"
        "  c: |\n"
        "    # text\n"
        "  d: 2\n"
        "fourth:\n"
        "  <<: *it\n"
        "fifth: [*it, {# no\n"
        "  e: 1}]\n"
    )
    found = read_comments(file)
    assert phrase(file) == "What it is"
    assert found.above == {("third",): "On the third", ("third", "a.b"): "inside"}
    assert found.behind[("second",)] == "of the value"
    file.write_text("")
    assert (phrase(file), read_comments.__wrapped__(file).above) == ("", {})


def test_switches_are_those_called_so():
    for program in ("train", "evaluate", "simulate"):
        for key in composed(program, *(["data=trips"] if program == "train" else []))[1]:
            is_switch = key.name.rpartition(".")[2] in SWITCHES
            assert is_switch == (key.limits == "true or false"), key


def test_comments_are_as_the_script_writes_them():
    for file in sorted(Path(CONFIGS).rglob("*.yaml")):
        text = file.read_text(encoding="utf-8")
        assert commented(file) == text, f"{file}: python benchmarks/docs_tables.py"
        assert max(map(len, text.splitlines())) <= COLUMNS, file


def test_script_writes_the_declared_sentence_over_another_comment(tmp_path):
    file = tmp_path / "model" / "svr.yaml"
    file.parent.mkdir()
    shipped = (Path(CONFIGS) / "model" / "svr.yaml").read_text(encoding="utf-8")
    file.write_text(shipped.replace("Stopping tolerance of libsvm [above 0]", "Other\n# words [m]"))
    assert "# Other\n# words [m]\ntol:" in file.read_text(encoding="utf-8")
    assert commented(file) == shipped


def test_ranges_of_the_programs_are_those_of_their_checks(quarter_car):
    told = {key.name: key.limits for name in ("train", "simulate") for key in composed(name)[1]}
    assert told["threads"] == "whole number; 1 to 1024; or null"
    for wrong in (0, 1025, 1.5):
        with pytest.raises((ValueError, TypeError), match="`threads` must be"):
            n_threads(wrong)
    assert told["scatter"] == "0 to 5"
    for wrong in (-0.1, 5.1):
        with pytest.raises(ValueError, match="`scatter` must be"):
            scattered(quarter_car, wrong, 0)


@pytest.mark.parametrize("module", [check, init], ids=lambda one: one.__name__)
def test_options_of_plain_programs_tell_unit_or_range(module):
    for action in options.PARSERS[module.__name__.rpartition(".")[2]]()._actions:
        if action.dest != "help":
            assert re.fullmatch(r".* \[[^\[\]]+\]", action.help), action
    assert "[" in typed(module, "--help", cwd=".").stdout
