"""A file of ``--config-dir`` sets what is documented, and executes, writes or sends nothing."""

import os
import re
import sys
from pathlib import Path

import pytest
import yaml
from cli_runner import SMALL, typed

from suspnet.cli import evaluate, monitor, replay, serve, simulate, train
from suspnet.cli.config_files import CONFIGS
from suspnet.cli.loader import ALLOWED

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
GLOBAL = "# @package _global_\n"
SECRET = "a password"
GADGET = "{_target_: suspnet.cli.config_files.Path.touch, _args_: [MARKER]}"
RESOLVER = "suspnet.cli.config_files.Path.touch"
LAUGHS = "\n".join(["a0: &a0 [ha]", *(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]" for i in range(1, 15))])
SWEEP = "mode: MULTIRUN, sweeper: {params: {seed: '1,2'}}"
NOT_SET = "cannot be set in a file of --config-dir, which may come from someone else: give it on"
NO_NAME = "names are letters, digits and _"
NO_WORDS = "must be a number, or words"
NO_GROUP = "has no keys of its own to set here; with a first line `# @package _global_`"
NO_DEFAULT = "`defaults` may hold _self_, one option of the same group, and `override /GROUP"
NO_HOST = "name the broker's host yourself"
SETTINGS = {
    NOT_SET: [
        # what is written, removed or read elsewhere
        "out: deep",
        "healthy: HOME",
        "source: {then: delete}",
        # who is reached, and who may do what
        "engineers: [Eve]",
        "source: {broker: {host: 127.0.0.1, port: 1}}",
        "source: {broker: {port: 1, password_env: AWS_SECRET_ACCESS_KEY}}",
        # Hydra's own blocks
        f"hydra: {{callbacks: {{x: {GADGET}}}}}",
        "hydra: {run: {dir: HOME}}",
        f"hydra: {{sweep: {{subdir: ../../home}}, {SWEEP}}}",
        "hydra: {job_logging: {handlers: {file: {class: logging.FileHandler, filename: MARKER}}}}",
        "hydra: {job: {env_set: {PYTHONSTARTUP: MARKER}}}",
        "hydra: {searchpath: ['pkg://evil_package']}",
    ],
    NO_NAME: [
        f"model: {GADGET}",
        f"protocol: {{groups: {{primary: {{outputs: [{GADGET}]}}}}}}",
        "scenario: {'()': x}",
        "'${oc.env:SECRET}': 1",
    ],
    NO_WORDS: [
        "model: ${oc.env:SECRET}",
        f"model: ${{oc.create:{{_target_:{RESOLVER},_args_:[MARKER]}}}}".replace("{_", "{ _"),
        "fleet: {suspension: '${store}'}",
        "vehicle: {source: '${oc.env:SECRET}'}",
        "vehicle: {name: '${${group}}'}",
        "job: ../../home",
        "groups: range(1,1000000000)",
    ],
    NO_DEFAULT: [
        "defaults: [override /vehicle: ../../../home/config]",
        "defaults: [override /hydra/launcher: joblib]",
        "defaults: [{model@hydra.launcher: evil}]",
        "defaults: [a, a]",
    ],
    "is no configuration: line": [
        "model: !!python/object/apply:os.system ['touch MARKER']",
        "model: &a {x: *a}",
        LAUGHS,
    ],
    "is no configuration: it must hold": ["[a]"],
    NO_HOST: ["source: {broker: {port: 1}}"],
}
"""What a file may not hold that sets keys of the whole configuration, by what is said of it."""
FILES = {
    "hydra/launcher/basic.yaml": (GADGET, ("-m", "seed=1,2"), NO_GROUP),
    "hydra/job_logging/evil.yaml": ("version: 1", ("hydra/job_logging=evil",), NO_GROUP),
    "vehicle/a/b/evil.yaml": ("name: x", ("vehicle=a/b/evil",), NO_GROUP),
    "vehicle/evil.yaml": (GADGET, ("vehicle=evil",), NO_NAME),
    "model/evil.yaml": ("# @package hydra.launcher\nx: 1", ("model=evil",), "no `# @package` but"),
    "evil.yaml": ("defaults: [train, _self_]\nseed: 1", ("--config-name=evil",), "GROUP/NAME.yaml"),
    "search/evil.yaml": ("defaults: [evil]", ("search=evil",), "refers to itself"),
    "model/hole.yaml": (None, ("model=hole",), "at most"),
    "experiment/evil.yaml": (
        GLOBAL + "hydra: {run: {dir: HOME}}",
        ("-m", "experiment=table6,evil"),
        NOT_SET,
    ),
}
"""Files that are refused whatever program reads them, the rest of a command line, and words."""
TYPED = {
    "elsewhere": ("vehicle=../../home/config", "leads out of the folder"),
    "package": ("hydra.searchpath=[pkg://evil_package]", "`hydra.searchpath` cannot be set"),
    "pickle": ("--experimental-rerun=PICKLE", "--experimental-rerun reads a pickle"),
    "abbreviated": ("--exp=PICKLE", "--experimental-rerun reads a pickle"),
}
ATTACKS = {
    **{
        f"{said[:12]}: {text[:60]}": ("x/evil.yaml", GLOBAL + text, ("+x=evil",), said)
        for said, texts in SETTINGS.items()
        for text in texts
    },
    **{name: (name, *rest) for name, rest in FILES.items()},
    **{name: (None, "", (argument,), said) for name, (argument, said) in TYPED.items()},
}
OTHER_PROGRAMS = {
    evaluate: ("run=x",),
    simulate: (),
    monitor: ("run=x", "suspensions=y", "store=fleet.db"),
    replay: ("trips=x",),
    serve: ("store=fleet.db", "port=0"),
}


def refused(program, attack, folder, monkeypatch, run=typed):
    """Run a program on a file of somebody else's; assert that it ends with nothing done."""
    name, text, arguments, said = attack
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("SECRET", SECRET)
    monkeypatch.delenv("SUSPNET_MQTT_HOST", raising=False)
    (cwd := folder / "cwd").mkdir()
    (home := folder / "home").mkdir()
    (home / "config.yaml").write_text("mine")
    (folder / "evil_package").mkdir()
    marker = folder / "marker"
    for code in (folder / "evil_package" / "__init__.py", folder / "pickle"):
        code.write_text(f"open({str(marker)!r}, 'w')\n")
    places = {"MARKER": str(marker), "HOME": str(home), "PICKLE": str(folder / "pickle")}

    def filled(words):
        return re.sub("MARKER|HOME|PICKLE", lambda place: places[place[0]], words)

    given = [filled(one) for one in arguments]
    if name:
        (file := folder / "theirs" / name).parent.mkdir(parents=True)
        file.write_text(filled(text or ""))
        if text is None:
            os.truncate(file, 2**40)
        given = ["--config-dir", folder / "theirs", *given]
    before = {path: path.lstat().st_mtime_ns for path in folder.rglob("*")}
    ended = run(program, *given, cwd=cwd)
    assert {path: path.lstat().st_mtime_ns for path in folder.rglob("*")} == before
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1
    assert said in ended.stderr
    assert SECRET not in ended.stdout + ended.stderr
    if name and "refers to itself" not in said:
        assert f"{folder / 'theirs' / name}" in ended.stderr


@pytest.mark.filterwarnings(r"ignore:\s+'hydra/:UserWarning")  # a name of Hydra's own options
@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_attack_is_refused_before_anything_is_done(attack, tmp_path, monkeypatch):
    refused(train, attack, tmp_path, monkeypatch)


@pytest.mark.parametrize("program", OTHER_PROGRAMS, ids=lambda one: one.__name__)
@pytest.mark.parametrize("text", ["hydra: {run: {dir: HOME}}", "fleet: {suspension: '${now:%Y}'}"])
def test_attack_is_refused_by_each_program(program, text, tmp_path, monkeypatch):
    said = NO_WORDS if "now" in text else NOT_SET
    attack = ("x/evil.yaml", GLOBAL + text, ("+x=evil", *OTHER_PROGRAMS[program]), said)
    refused(program, attack, tmp_path, monkeypatch)


VEHICLE = yaml.safe_dump(yaml.safe_load(Path(CONFIGS, "vehicle", "am96.yaml").read_text()))
BEST = f"""{GLOBAL}# python train.py --config-dir outputs/table5/TIME experiment=best
tuned:
  primary:
    msvr: {{C: 100.0, epsilon: 1.0e-06, sigma: 3.0}}
# primary, msvr: C is at the edge
"""
EXPERIMENT = f"""{GLOBAL}defaults: [override /protocol: trips, override /data: trips, _self_]
job: mine
speed_m_per_s: [45, 80]
data: {{n_train: 77, snr_db: null, rates_hz: [1000, 1000, 500.5], track: '${{track}}'}}
model: {{random_state: '${{seed}}', sigma: scale}}
"""
MODEL = "defaults: [msvr]\nC: 7\n"
BROKER = f"""{GLOBAL}GROUP: {{broker: {{port: 8883, tls: true, ca_file: /etc/ca.crt, user: us}}}}
"""
LIMITS = f"{GLOBAL}limits: {{k_p: {{notice: [0.9, 1.1]}}}}\nplan: {{risk: 0.07}}\n"
WATCHED = f"{GLOBAL}monitor: {{trips: {{level: 0.8}}}}\n"
SCENARIO = "defaults: [healthy]\nname: mine\nchanges: {k_p: {from_km: 1, to_km: 2, ratio: 0.5}}\n"
USES = {
    # file, its text, program, the rest of the command, and what is then configured
    "vehicle": ("vehicle/mine", VEHICLE, train, ("vehicle=mine",), "  bogie_mass_kg: 1725.0"),
    "best": ("experiment/best", BEST, train, ("experiment=best",), "      epsilon: 1.0e-06"),
    "experiment": ("experiment/mine", EXPERIMENT, train, ("experiment=mine",), "  n_train: 77"),
    "scenario": ("scenario/mine", SCENARIO, simulate, ("scenario=mine",), "      ratio: 0.5"),
    "model": ("model/mine", MODEL, train, ("model=mine",), "  C: 7"),
    "limits": ("fleet/mine", LIMITS, serve, ("+fleet=mine", "store=x"), "  risk: 0.07"),
    "monitor": ("fleet/mine", WATCHED, evaluate, ("+fleet=mine", "run=x"), "    level: 0.8"),
    "broker": (
        *("fleet/mine", BROKER.replace("GROUP", "source"), monitor),
        ("+fleet=mine", "source=mqtt", "source.broker.host=depot.lan"),
        "    port: 8883",
    ),
    "command line": (
        *("experiment/mine", EXPERIMENT, train),
        ("experiment=mine", "job='a/${oc.env:HOME}'", "hydra.run.dir=x", "hydra.verbose=true"),
        "job: a/${oc.env:HOME}",
    ),
}


@pytest.mark.parametrize("use", USES.values(), ids=USES)
def test_what_is_documented_works(use, tmp_path):
    name, text, program, arguments, line = use
    (file := tmp_path / "mine" / f"{name}.yaml").parent.mkdir(parents=True)
    file.write_text(text)
    ended = typed(program, "--cfg=job", "--config-dir=mine", *arguments, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert line in ended.stdout.splitlines()


def test_host_of_a_broker_may_be_in_the_environment(tmp_path):
    (file := tmp_path / "mine" / "fleet" / "mine.yaml").parent.mkdir(parents=True)
    file.write_text(BROKER.replace("GROUP", "source"))
    given = ("--cfg=job", "--config-dir=mine", "+fleet=mine", "source=mqtt")
    ended = typed(monitor, *given, cwd=tmp_path, SUSPNET_MQTT_HOST="depot.lan")
    assert "  tls: true" in ended.stdout


def test_no_key_of_a_path_may_be_set_but_that_of_authorities():
    comments = pytest.importorskip("config_comments", reason="needs benchmarks")
    paths, data = set(), set()
    for file in Path(CONFIGS).rglob("*.yaml"):
        group = "" if file.parent == Path(CONFIGS) else f"{file.parent.name}."
        for keys, sentence in comments.read_comments(file).above.items():
            key = group + ".".join(keys)
            if group == "data.":
                data.add(key)
            if re.search(r"\[[^\]]*\b(path|URL|file)\b", sentence):
                paths.add(key.removeprefix("base."))
    allowed = {key for key in paths if any(f"{key}.".startswith(f"{one}.") for one in ALLOWED)}
    assert {"resume", "store", "source.folder", "ca_file"} <= paths
    assert allowed == set()
    assert {key for key in ALLOWED if key.startswith("data.")} == data | {"data.kind"}


@pytest.mark.parametrize("kind", ["pipe", "endless"])
def test_what_is_no_file_is_no_configuration(kind, tmp_path):
    (file := tmp_path / "theirs" / "vehicle" / "evil.yaml").parent.mkdir(parents=True)
    os.mkfifo(file) if kind == "pipe" else file.symlink_to("/dev/zero")
    ended = typed(train, "--config-dir=theirs", "vehicle=evil", *SMALL, cwd=tmp_path)
    assert ended.returncode == 1
    assert "Could not find 'vehicle/evil'" in ended.stderr
