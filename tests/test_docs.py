"""README, CONTRIBUTING and docs: links, commands, snippets, tables and the layout are true."""

import ast
import importlib
import re
import shlex
import sys
import textwrap
from pathlib import Path

import pytest
import yaml
from hydra import compose, initialize_config_dir
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from trip_fixtures import model_at, small_fleet

import suspnet
from suspnet.cli.config_files import CONFIGS, TABLES
from suspnet.cli.loader import of_healthy
from suspnet.cli.options import PARSERS
from suspnet.curves.curves import CurveSettings
from suspnet.curves.problem import Problem
from suspnet.estimation.checkpoint import save_model
from suspnet.learning import LinearRegression
from suspnet.runs.fit import fit
from suspnet.runs.predict import calibrated
from suspnet.trains.recordings.manifest_files import read_manifest

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "benchmarks"))
import docs_tables  # noqa: E402

README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = {
    "python train.py": "train",
    "python evaluate.py": "evaluate",
    **{
        f"suspnet{sign}{name}": name
        for name in ("train", "evaluate", "simulate", "replay", "monitor", "serve")
        for sign in " -"
    },
}
MOST_LINES = 70
NEEDS_PLUGIN = "hydra/launcher", "hydra.launcher"
"""Begin overrides that only an extra of the package understands."""
PLACEHOLDERS = "experiment=best", "vehicle=mine", "vehicle=NAME"
"""Overrides whose options the user's own --config-dir holds."""
OF_EXAMPLES = {"configs/model/kernel_ridge.yaml"}
"""Files that a page tells a reader to write."""
OF_PROGRAM = {"-m", "--help", "--cfg", "job"}
"""Arguments of a command that are no overrides."""


def blocks(page):
    """Return the code of a page: blocks indented by four spaces, or between fences."""
    text = page.read_text(encoding="utf-8")
    fenced = re.findall(r"^```\w*\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    rest = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    indented = re.findall(r"(?:^(?: {4}.*)?\n)+", rest, re.MULTILINE)
    return fenced + [code for block in indented if (code := textwrap.dedent(block).strip())]


def commands():
    """Return every command line of all pages that starts one of the programs."""
    found = []
    for page in PAGES:
        for line in "\n".join(blocks(page)).replace("\\\n", " ").splitlines():
            for part in re.split(r"&&?|\|", line):
                part = part.strip()
                if part.startswith(tuple(PROGRAMS)):
                    found.append(part)
    return sorted(set(found))


def overrides_of(line):
    """Return the program of a command line and its overrides, placeholders left out."""
    start = next(start for start in PROGRAMS if line.startswith(start))
    words = shlex.split(line.removeprefix(start), comments=True)
    if "--config-dir" in words:
        place = words.index("--config-dir")
        words = [word for word in words[:place] + words[place + 2 :] if word not in PLACEHOLDERS]
    words = [w for w in words if w not in OF_PROGRAM and not w.startswith(NEEDS_PLUGIN)]
    typed = dict(word.lstrip("+").partition("=")[::2] for word in words)
    implied = of_healthy(typed, (), str) if PROGRAMS[start] == "train" else []
    return PROGRAMS[start], [*implied, *words]


def is_of_group(key):
    """Return whether a key of the command line chooses one of several files."""
    return key in TABLES or (Path(CONFIGS) / key).is_dir()


def jobs(overrides):
    """Return the overrides of jobs that try each option of a swept group, and a swept key once."""
    values = {}
    for one in OverridesParser.create().parse_overrides(overrides):
        swept = list(one.sweep_string_iterator()) if one.is_sweep_override() else None
        which = slice(None if is_of_group(one.key_or_group) else 1)
        values[one.key_or_group] = swept[which] if swept else [one.get_value_string()]
    return [
        tuple(f"{key}={each[k % len(each)]}" for key, each in values.items())
        for k in range(max(map(len, values.values()), default=1))
    ]


def imported(node):
    """Return the modules of the package below its top that a node of a module imports."""
    if isinstance(node, ast.Import):
        names = [alias.name for alias in node.names]
    elif isinstance(node, ast.ImportFrom) and node.module == "suspnet":
        public = suspnet.__all__
        names = [f"suspnet.{alias.name}" for alias in node.names if alias.name not in public]
    else:
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
    return [name for name in names if name.startswith("suspnet.") and not name.endswith("__")]


def python_blocks(page):
    return [code for code in blocks(page) if re.match(r"(import|from) \w+", code)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory, task, quarter_car):
    """Return the folders of a model of curves and of one of trips, and a trip."""
    folder = tmp_path_factory.mktemp("runs")
    settings = CurveSettings(300, 100, 200)
    problem = Problem(quarter_car, task(), settings)
    save_model(folder / "train", calibrated(problem, fit(problem, LinearRegression(), None)))
    save_model(folder / "trips", model_at())
    return {
        "outputs/train/RUN": folder / "train",
        "outputs/curves": folder / "train",
        "outputs/trips/RUN": folder / "trips",
        "trip.yaml": small_fleet()[0],
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_relative_link_leads_to_a_file(page):
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8"))
    for link in links:
        file, _, heading = link.partition("#")
        if re.match(r"\w+:", link):
            continue
        target = page.parent / file if file else page
        assert target.exists(), link
        if heading:
            titles = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.MULTILINE)
            assert heading in [re.sub(r"[^\w\- ]", "", t).lower().replace(" ", "-") for t in titles]


def test_every_command_composes():
    asked = {}
    for line in commands():
        program, overrides = overrides_of(line)
        for job in jobs(overrides):
            plain = [one for one in job if not is_of_group(one.partition("=")[0])]
            options = program, tuple(one for one in job if one not in plain)
            keys, lines = asked.setdefault(options, ({}, []))
            keys |= {one.partition("=")[0]: one for one in plain}  # to be composed all at once
            lines.append(line)
    assert sum(len(lines) for _, lines in asked.values()) > 30
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        for (program, options), (keys, lines) in asked.items():
            try:
                compose(program, [*options, *keys.values()])
            except HydraException as error:
                raise AssertionError(f"one of {lines}: {error}") from error


def test_settings_of_the_generator_in_sentences_compose():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    spans = set(re.findall(r"`(\"?generator\.[\w.]+=[^`\n]+)`", text))
    found = sorted({shlex.split(span)[0] for span in spans})
    assert len(found) >= 4
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        for one in found:
            compose("train", ["experiment=trips", "generator=family", one])


def test_every_file_that_is_named_exists():
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    named = set(re.findall(r"\b(?:tests|suspnet|configs)/[\w/]+\.(?:py|yaml|csv|md|png)\b", text))
    assert len(named) > 50
    files = [name for name in named if name not in OF_EXAMPLES and "/NAME." not in name]
    assert [name for name in files if not (ROOT / name).is_file()] == []
    rooms = "|".join(path.parent.name for path in ROOT.glob("suspnet/*/**/__init__.py"))
    short = set(re.findall(rf"`((?:{rooms})/\w+\.py)`", text))
    assert len(short) > 20
    assert [name for name in short if not any(ROOT.glob(f"suspnet/**/{name}"))] == []


def test_every_command_of_other_programs_is_understood():
    lines = [
        shlex.split(line, comments=True)
        for page in PAGES
        for line in "\n".join(blocks(page)).replace("\\\n", " ").splitlines()
        if re.match("suspnet[ -](check|init|history) ", line)
    ]
    assert len(lines) >= 4
    for first, *rest in lines:
        words = [*first.split("-"), *rest][1:]
        PARSERS[words[0]]().parse_args(words[1:])  # exits where it does not know one


def test_scripts_of_the_benchmarks_import_what_there_is():
    for file in (ROOT / "benchmarks").glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            for module in imported(node):
                found = importlib.import_module(module)
                for alias in node.names if isinstance(node, ast.ImportFrom) else ():
                    assert hasattr(found, alias.name), f"{file}: {module} has no {alias.name}"


def test_readme_is_short_and_has_the_two_commands_on_lines_of_their_own():
    lines = README.read_text(encoding="utf-8").splitlines()
    assert len(lines) <= MOST_LINES
    assert "    pip install -e . && python train.py experiment=table6" in lines
    assert '    pip install -e ".[test]" && pytest' in lines


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_of_the_results(page):
    text = page.read_text(encoding="utf-8")
    assert docs_tables.filled(text)[0] == text, "run python benchmarks/docs_tables.py"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_manifests_are_accepted(page, tmp_path):
    for code in blocks(page):
        if not code.startswith("format: suspnet-trip-1"):
            continue
        content = yaml.safe_load(code)
        for source in [content["speed"], *content["channels"].values()]:
            (tmp_path / source["file"]).touch()
        (tmp_path / "trip.yaml").write_text(code)
        assert read_manifest(tmp_path / "trip.yaml").vehicle == "am96"


def test_snippets_run(runs, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write files
    snippets = [code for page in PAGES for code in python_blocks(page)]
    assert len(snippets) >= 3
    for code in snippets:
        for name, path in runs.items():
            code = code.replace(f'"{name}"', repr(str(path)))
        exec(compile(code, "snippet", "exec"), {})
    assert "k_p" in capsys.readouterr().out
