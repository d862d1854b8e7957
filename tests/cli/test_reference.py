"""`--help`: each key has a sentence with unit and range, and the ranges are those of checks."""

import pickle
import re
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from cli_runner import typed
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from suspnet.cli import check, evaluate, init, options, simulate, train
from suspnet.cli.config_files import CONFIGS, SWITCHES, TABLES, phrase, read_comments
from suspnet.cli.kinds import build
from suspnet.cli.program import n_threads
from suspnet.cli.reference import COLUMNS, Reference
from suspnet.simulation.true_vehicle import scattered

ROOT = Path(__file__).parents[2]
sys.path += [str(ROOT / "tests" / "benchmarks"), str(ROOT / "docs")]
import configuration_page  # noqa: E402
from config_comments import commented  # noqa: E402

LONGEST = 260
"""Number of characters of a sentence beyond which nobody reads it."""
CHOSEN = [
    *(("train", f"model={file.stem}") for file in sorted((Path(CONFIGS) / "model").glob("*"))),
    *(("train", f"experiment={f.stem}") for f in sorted((Path(CONFIGS) / "experiment").glob("*"))),
    ("train", "search=widened"),
    ("evaluate", "protocol=joint"),
    ("evaluate", "study=identifiability"),
    ("simulate", "scenario=random"),
    *(("replay", f"sink={file.stem}") for file in sorted((Path(CONFIGS) / "sink").glob("*"))),
]
BUILT = {
    ("train", "vehicle=am96"): ("vehicle",),
    ("train", "experiment=trips"): ("generator", "data", "protocol.curve"),
    ("train", "data=curves"): ("data", "protocol"),
    ("train", "search=table5"): ("search",),
    ("train", "model=curve_fit"): ("model",),
    ("train", "model=msvr"): ("model",),
    ("train", "model=mvgpr"): ("model",),
    ("train", "model=svr"): ("model",),
    ("evaluate", "run=x"): ("monitor",),
    ("simulate", "scenario=healthy"): ("fleet", "scenario"),
    ("replay", "sink=mqtt"): ("sink",),
    ("monitor", "run=x"): ("live", "source", "monitor"),
    ("serve", "store=x"): ("plan", "sisters", "changes"),
}
"""Command lines with the beginnings of keys that the objects of their sections check."""
UNCHECKED = {"cache_size_mb", "n_jobs", "random_state", "nominal", "distribution", "limits", "seed"}
"""Keys that scikit-learn checks, or whose values are mappings."""
NUMBER = r"(-?[\d.]+(?:e\d+)?)"
RANGE = re.compile(
    rf"(?:{NUMBER} to {NUMBER}|"
    rf"(?:(above|at least) {NUMBER})?(?: and )?(?:(below|at most) {NUMBER})?)"
)


def composed(name, *overrides):
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(name, overrides=list(overrides), return_hydra_config=True)
        return config, Reference(config).keys()


@pytest.mark.representatives(6)
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
        assert commented(file) == text, f"{file}: python tests/benchmarks/docs_tables.py"
        assert max(map(len, text.splitlines())) <= COLUMNS, file


def test_script_writes_the_declared_sentence_over_another_comment(tmp_path):
    file = tmp_path / "model" / "svr.yaml"
    file.parent.mkdir()
    shipped = (Path(CONFIGS) / "model" / "svr.yaml").read_text(encoding="utf-8")
    file.write_text(shipped.replace("Stopping tolerance of libsvm [above 0]", "Other\n# words [m]"))
    assert "# Other\n# words [m]\ntol:" in file.read_text(encoding="utf-8")
    assert commented(file) == shipped


def refused(pickled, section, key, value):
    """Return what an object says of a value of a key, if it says that it must be another one."""
    config = pickle.loads(pickled)  # faster than copy.deepcopy
    OmegaConf.update(config, key.name, value)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            built = build(config, section)
            if hasattr(built, "fit"):
                built.fit(np.arange(8.0)[:, None], np.arange(16.0).reshape(8, 2))
    except (ValueError, TypeError) as error:
        name = key.name.rpartition(".")[2]
        found = re.search(rf"`(?:\w+\.)*{name}(?:\[\d\])?` must be ([^\n]*)", str(error))
        return found and found[1]
    return None


def points(limits):
    """Return values at the ends of a range, and values beyond them."""
    parts = limits.split("; ")
    is_whole = limits.startswith("whole number")
    step, kind = (1, int) if is_whole else (1e-6, float)
    inside, outside = [], []
    for part in parts:
        found = RANGE.fullmatch(part)
        if not found or not part:
            continue
        low, high = (kind(float(one)) for one in found.groups()[:2]) if found[1] else (None, None)
        if low is not None:
            inside += [low, high]
            outside += [low - step * max(1, abs(low)), high + step * max(1, abs(high))]
        for word, number, sign in ((found[3], found[4], -1), (found[5], found[6], 1)):
            if number is None:
                continue
            edge = kind(float(number))
            beyond = edge + kind(sign * step * max(1, abs(edge)))
            within = edge - kind(sign * step * max(1, abs(edge)))
            is_edge_in = word in ("at least", "at most")
            inside.append(edge if is_edge_in else within)
            outside.append(beyond if is_edge_in else edge)
    return inside, outside


def choices(limits):
    """Return the words that a key may have; none if it is no choice of words."""
    words = re.split(r", | or ", limits.partition("; ")[0].removeprefix("list of "))
    is_choice = len(words) > 1 and all(map(str.isidentifier, words))
    return set(words) if is_choice and limits not in ("true or false", "cpu or cuda") else set()


@pytest.mark.parametrize(("line", "sections"), BUILT.items(), ids=lambda one: " ".join(one))
def test_ranges_are_those_of_the_checks(line, sections):
    config, rows = composed(*line)
    config = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
    pickled, n_checked = pickle.dumps(config), 0
    for key in rows:
        section, name = key.name.partition(".")[0], key.name.rpartition(".")[2]
        inside, outside = points(key.limits)
        words = choices(key.limits)
        is_checked = any(key.name.startswith(f"{one}.") for one in sections)
        is_checked = is_checked and not key.value.startswith("{")
        if not is_checked or name in UNCHECKED or not (outside or words):
            continue
        n_checked += 1
        is_list = key.value.startswith("[")
        for value in inside:
            assert not refused(pickled, section, key, [value] * 3 if is_list else value), key
        for value in [*outside, *(["nonsense"] if words else [])]:
            rule = refused(pickled, section, key, [value] * 3 if is_list else value)
            assert rule, (key, value)
            if words:
                assert set(re.findall(r"'(\w+)'", rule)) - {"nonsense"} == words
        if not is_list:
            assert bool(refused(pickled, section, key, None)) == ("or null" not in key.limits), key
    assert n_checked > 0


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
