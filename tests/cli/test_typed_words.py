"""A path reaches each program as typed, and the commands that programs print can be pasted."""

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from cli_runner import typed
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from trip_fixtures import small_fleet

from suspnet.cli import check, folders, replay
from suspnet.cli.commission_fleet import first_trips
from suspnet.cli.config_files import CONFIGS
from suspnet.cli.typed_words import FOLDERS_OF_HYDRA, PATHS, as_overrides, listed, of_each_name
from suspnet.ground.wording import command

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
NAMES = (
    *("Züge", "a b", " a", "a=b", "a,b", "a;b", "a(b)", "sort(1,2)", "a[b]", "[b]", "[a,b]"),
    *("a{b}", "{b}", "a&b", "#b", "a #b", "it's", '"q"', "'q'", "417_003", "4711", "1e3", "true"),
    *("nan", "-x", "2026-08-03", "a\\", "\\'", "~", "a:b", "%41", "a*b?", "two\nlines", "列车"),
    *("a/b c/", "${x}"),
)
"""Names of folders that Hydra's grammar refuses, or reads as lists, numbers or calls."""


def read(words):
    """Return what Hydra and OmegaConf read from the words of a command line, by key."""
    overrides = [one for one in as_overrides(words) if one != "-m"]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return OmegaConf.create({one.key_or_group: one.value() for one in parsed})


def pasted(line):
    """Return the words behind ``suspnet PROGRAM`` of a printed line, as a shell reads them."""
    return shlex.split(line[line.index("suspnet ") :])[2:]


def test_the_paths_are_the_keys_whose_unit_is_a_path():
    comments = pytest.importorskip("config_comments", reason="needs benchmarks")
    stated = set()
    for file in Path(CONFIGS).rglob("*.yaml"):
        group = {"": "", "sink": "sink.", "source": "source.", "data": "data."}
        before = group.get(file.parent.name if file.parent != Path(CONFIGS) else "", None)
        for keys, sentence in comments.read_comments(file).above.items():
            if re.search(r"\[path\b[^\]]*\]$", sentence):
                assert keys[-1] in {key.rpartition(".")[2] for key in (*PATHS, "run")}, (file, keys)
                stated.add((before or "") + ".".join(keys) if before is not None else keys[-1])
    brokers = {key for key in PATHS if ".broker." in key}
    assert stated - {key.rpartition(".")[2] for key in brokers} == {*PATHS, "run"} - brokers


@pytest.mark.parametrize("name", NAMES)
def test_any_name_is_the_value_of_each_key_of_paths(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path(name).mkdir(parents=True)
    of_hydra = () if "${" in name else FOLDERS_OF_HYDRA[:1]  # interpolations are of use there
    for key in ("trips", "source.broker.ca_file", "run", *of_hydra):
        for marks in ("", "++"):
            assert read([f"{marks}{key}={name}"])[key] == name
            assert read(["-m", f"{marks}{key}={name}"])[key] == name
        assert read(pasted(command("evaluate", f"{key}={name}")))[key] == name
    runs = [name, "outputs/b", name]
    assert list(read(pasted(command("evaluate", f"run={listed(runs)}"))).run) == runs


def test_what_is_no_path_and_what_hydra_reads_as_typed_stays():
    words = ["seed=1", "model.C=1e3", "data.rates_hz=[1,2]", "store=null", "run=[a,b/c]", "~data"]
    words += ["--config-dir", "trips=a,b", "trips='in quotes'", "out=trips/new_1"]
    words += ["-m", "run=sort(b,a)", "trips=a,b"]
    assert as_overrides(words) == words
    assert read(["run=['Züge 1','a,b', c d]"]).run == ["Züge 1", "a,b", "c d"]


def test_numbers_of_suspensions_with_any_name_are_read():
    word = "n_healthy={417_003:4,Züge_links:3}"
    numbers = OmegaConf.create({"n": of_each_name(read([word]).n_healthy)}).n
    assert isinstance(numbers, DictConfig)
    assert first_trips(numbers, ["417_003", "Züge_links"]) == {"417_003": 4, "Züge_links": 3}


def test_programs_take_and_print_a_path_with_signs(tmp_path):
    name = "Wagen=4711, [a] & {b};#c"
    for manifest in small_fleet()[:3]:
        shutil.copytree(manifest.with_suffix(""), tmp_path / name / manifest.stem)
        shutil.copy(manifest, tmp_path / name)
    checked = typed(check, name, "--no-pictures", "-o", f"{name}/x", cwd=tmp_path)
    (line,) = [line for line in checked.stdout.splitlines() if line.startswith("then run: ")]
    assert read(pasted(line)).healthy == name
    words = [f"trips={name}", "out=417_003", f"hydra.run.dir={name} 2"]
    sent = typed(replay, *words, cwd=tmp_path)
    assert (sent.returncode, sent.stdout) == (0, ""), sent.stderr
    assert list((tmp_path / "417_003").iterdir())
    assert (tmp_path / f"{name} 2" / ".hydra").is_dir()


def test_resumption_is_printed_for_a_shell(monkeypatch):
    monkeypatch.setattr(folders, "to_resume", ["Läufe [1], it's"])
    assert shlex.split(folders.how_to_resume())[-1] == "resume=Läufe [1], it's"


def test_a_name_of_a_run_is_short_in_bytes():
    assert len(folders.joined_name(["列" * 90]).encode()) <= folders.MAX_BYTES
    assert re.fullmatch("_列+", folders.joined_name(["列" * 90]))
