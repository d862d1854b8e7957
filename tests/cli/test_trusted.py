"""A configuration of someone else's executes nothing and writes nothing, in every program."""

import os
import pickle
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from cli_runner import SMALL, command, typed
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.types import RunMode
from hydra.utils import get_object
from omegaconf import OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

from suspnet.cli import evaluate, simulate, train, trusted
from suspnet.cli.kinds import KINDS
from suspnet.cli.loader import CheckedLoader, check_typed

RUNSTRING = (
    "{_target_: suspnet.estimation.checkpoint.np.testing.runstring, "
    "astr: \"open('MARKER', 'w')\", dict: {}}"
)
TOUCH = "{_target_: suspnet.cli.config_files.Path.touch, _args_: [MARKER]}"
UNLINK = "{_target_: suspnet.simulation.writing.Path.unlink, _args_: [VICTIM]}"
LOAD = "{_target_: suspnet.ground.tensors.torch.load, _args_: [PICKLE], weights_only: false}"
WRITE = (
    "{_target_: suspnet.ground.storage.write_atomically, content: x, "
    "path: {_target_: suspnet.ground.storage.Path, _args_: [MARKER]}}"
)
EXEC = "{_target_: builtins.exec, _args_: [\"open('MARKER', 'w')\"]}"
CALL = "{_target_: subprocess.check_call, _args_: [[touch, MARKER]]}"
CHECKPOINT = "suspnet.estimation.checkpoint"
LINE = f"{{_target_: {CHECKPOINT}.np.testing.measure, code_str: \"open('MARKER', 'w')\"}}"
GADGETS = {
    "runstring": RUNSTRING,
    "touch": TOUCH,
    "unlink": UNLINK,
    "torch_load": LOAD,
    "write_atomically": WRITE,
    "exec": EXEC,
    "subprocess": CALL,
    "measure": LINE,
}
"""What writes MARKER, removes VICTIM or unpickles PICKLE if it is instantiated."""
SLOW = {"unlink", "write_atomically", "exec", "subprocess", "measure"}
"""Gadgets that are tried in the slow tests only."""
HANDLER = "{class: logging.FileHandler, filename: MARKER}"
FACTORY = (
    "{\"()\": suspnet.estimation.checkpoint.np.testing.runstring, astr: \"open('MARKER', 'w')\"}"
)
EXPERIMENT = "# @package _global_\n"


@dataclass(frozen=True)
class Payload:
    """Files of a folder for --config-dir, and a command line."""

    name: str
    files: dict[str, str] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    program: str = "train"


def in_experiment(name, text, *arguments):
    """Return a payload of train.py in the file of an experiment."""
    return Payload(
        name, {"experiment/evil.yaml": EXPERIMENT + text}, ("experiment=evil", *arguments)
    )


def in_scenario(name, text):
    files = {"scenario/evil.yaml": "defaults: [healthy]\n" + text}
    return Payload(name, files, ("scenario=evil",), "simulate")


def in_study(name, text):
    return Payload(
        name, {"study/evil.yaml": EXPERIMENT + text}, ("study=evil", "run=x"), "evaluate"
    )


def everywhere(text):
    """Return each gadget in the place that TEXT names by GADGET."""
    return [(name, text.replace("GADGET", gadget)) for name, gadget in GADGETS.items()]


PAYLOADS = [
    # the objects that programs build, and what lies inside of them
    *[in_experiment(f"model__{n}", t) for n, t in everywhere("model: GADGET")],
    *[in_study(f"study__{n}", t) for n, t in everywhere("study: GADGET")],
    *[in_scenario(f"changes__{n}", t) for n, t in everywhere("changes: {k_p: GADGET}")],
    in_experiment("callback_of_a_model", f"model: {{callback: {TOUCH}}}"),
    in_experiment("vehicle", f"vehicle: {TOUCH}"),
    in_experiment("generator", f"generator: {TOUCH}"),
    in_experiment("data", f"data: {TOUCH}"),
    in_experiment("search", f"search: {RUNSTRING}"),
    in_experiment("in_a_list", f"protocol: {{groups: {{primary: {{outputs: [{TOUCH}]}}}}}}"),
    in_experiment("three_deep", f"protocol: {{features: {{a: {{b: {{c: {RUNSTRING}}}}}}}}}"),
    Payload("option_of_vehicle", {"vehicle/evil.yaml": TOUCH}, ("vehicle=evil",)),
    Payload("ablation", {"ablation/evil.yaml": f"{EXPERIMENT}model: {TOUCH}"}, ("ablation=evil",)),
    Payload(
        "fleet",
        {"scenario/evil.yaml": EXPERIMENT + f"fleet: {TOUCH}"},
        ("scenario=evil",),
        "simulate",
    ),
    in_study("monitor", f"study: null\nmonitor: {TOUCH}\ntrips: x"),
    in_study("trips_of_monitor", f"study: null\nmonitor: {{trips: {RUNSTRING}}}\ntrips: x"),
    in_study("protocol_of_evaluate", f"study: null\nprotocol: {TOUCH}"),
    # our own functions and classes, where they do not belong
    in_experiment(
        "study_as_model",
        "model: {_target_: suspnet.runs.identifiability.write_identifiability, folder: CWD}",
    ),
    in_experiment(
        "writer_as_model",
        "model: {_target_: suspnet.ground.storage.write_json, path: MARKER, content: 1}",
    ),
    in_experiment("vehicle_as_model", "model: ${vehicle}"),
    in_experiment("private_home_of_a_class", "model: {_target_: suspnet.learning.msvr.MSVR}"),
    # what else steers Hydra's instantiate
    in_experiment("partial", "model: {_partial_: true}"),
    in_experiment("arguments", "model: {_args_: [1]}"),
    in_experiment("not_recursive", "model: {_recursive_: false}"),
    in_experiment("convert", "model: {_convert_: object}"),
    # targets that appear when values are resolved
    in_experiment(
        "created",
        f"payload: '{TOUCH}'\nmodel: ${{oc.create:${{payload}}}}".replace("'{_", '"{_').replace(
            "}'\n", '}"\n'
        ),
    ),
    in_experiment(
        "created_from_text",
        'model: "${oc.create:{_target_:suspnet.cli.config_files.Path.touch,_args_:[MARKER]}}"',
    ),
    in_experiment("decoded", f'payload: "{TOUCH}"\nmodel: ${{oc.decode:${{payload}}}}'),
    in_experiment("hidden_resolver", f'r: oc\np: "{TOUCH}"\nmodel: ${{${{r}}.create:${{p}}}}'),
    in_experiment(
        "target_elsewhere",
        "t: suspnet.cli.config_files.Path.touch\nmodel: {_target_: '${t}', _args_: [MARKER]}",
    ),
    in_experiment(
        "target_in_parts",
        "t: cli.configs.Path.touch\nmodel: {_target_: 'suspnet.${t}', _args_: [MARKER]}",
    ),
    in_experiment(
        "target_from_the_environment", "model: {_target_: '${oc.env:EVIL}', _args_: [MARKER]}"
    ),
    in_experiment("node_elsewhere", f"x: {TOUCH}\nmodel: ${{x}}"),
    in_experiment("selected", f"x: {TOUCH}\nmodel: ${{oc.select:x}}"),
    in_experiment(
        "values_of_a_mapping", f"x: {{a: {TOUCH}}}\ny: ${{oc.dict.values:x}}\nmodel: ${{y.0}}"
    ),
    in_experiment("deprecated", f"x: {TOUCH}\nmodel: ${{oc.deprecated:x}}"),
    in_experiment("each_other", "x: {y: '${z}'}\nz: {w: '${x}'}"),
    in_experiment(
        "doubled", "x0: 1\n" + "".join(f"x{i + 1}: ['${{x{i}}}', '${{x{i}}}']\n" for i in range(30))
    ),
    # Hydra's own blocks
    *[
        in_experiment(f"hydra_callback__{n}", t)
        for n, t in everywhere("hydra: {callbacks: {x: GADGET}}")
    ],
    in_experiment("callback_elsewhere", f"x: {TOUCH}\nhydra: {{callbacks: {{x: '${{x}}'}}}}"),
    in_experiment(
        "argument_of_our_callback",
        f"hydra: {{callbacks: {{x: {{_target_: suspnet.runs.sweeps.Table6, note: {TOUCH}}}}}}}",
    ),
    in_experiment(
        "pickling_callback",
        "hydra: {callbacks: {x: {_target_: hydra.experimental.callbacks.PickleJobInfoCallback}}}",
    ),
    in_experiment("launcher", f"hydra: {{launcher: {RUNSTRING}}}", "-m", "seed=1,2"),
    in_experiment(
        "argument_of_the_launcher", f"hydra: {{launcher: {{x: {TOUCH}}}}}", "-m", "seed=1"
    ),
    in_experiment("sweeper", f"hydra: {{sweeper: {RUNSTRING}}}", "-m", "seed=1,2"),
    in_experiment("argument_of_the_sweeper", f"hydra: {{sweeper: {{x: {TOUCH}}}}}", "-m", "seed=1"),
    in_experiment("nested_in_swept", f"hydra: {{sweeper: {{params: {{seed: {TOUCH}}}}}}}", "-m"),
    Payload("shadowed_launcher", {"hydra/launcher/basic.yaml": TOUCH}, ("-m", "seed=1,2")),
    Payload("shadowed_sweeper", {"hydra/sweeper/basic.yaml": TOUCH}, ("-m", "seed=1,2")),
    Payload(
        "another_launcher",
        {"hydra/launcher/evil.yaml": RUNSTRING},
        ("-m", "hydra/launcher=evil", "seed=1,2"),
    ),
    in_experiment(
        "commands_of_a_cluster",
        "hydra: {launcher: {_target_: hydra_plugins."
        "hydra_submitit_launcher.submitit_launcher.SlurmLauncher, "
        "setup: [touch MARKER]}}",
        "-m",
        "seed=1,2",
    ),
    in_experiment(
        "expression_of_joblib",
        "hydra: {launcher: {_target_: hydra_plugins."
        "hydra_joblib_launcher.joblib_launcher.JoblibLauncher, "
        "pre_dispatch: \"open('MARKER', 'w')\"}}",
        "-m",
        "seed=1,2",
    ),
    in_experiment("handler_class", f"hydra: {{job_logging: {{handlers: {{file: {HANDLER}}}}}}}"),
    in_experiment("handler_factory", f"hydra: {{job_logging: {{handlers: {{file: {FACTORY}}}}}}}"),
    in_experiment(
        "formatter_factory", f"hydra: {{job_logging: {{formatters: {{simple: {FACTORY}}}}}}}"
    ),
    in_experiment("filter_factory", f"hydra: {{job_logging: {{filters: {{x: {FACTORY}}}}}}}"),
    in_experiment(
        "imported_stream",
        "hydra: {job_logging: {handlers: {console: {stream: 'ext://evil_package.x'}}}}",
    ),
    in_experiment("log_elsewhere", "hydra: {job_logging: {handlers: {file: {filename: MARKER}}}}"),
    in_experiment(
        "hydra_logging_class",
        f"hydra: {{hydra_logging: {{handlers: {{console: {HANDLER}}}}}}}",
        "-m",
        "seed=1",
    ),
    in_experiment(
        "hydra_logging_factory", f"hydra: {{hydra_logging: {{handlers: {{console: {FACTORY}}}}}}}"
    ),
    Payload(
        "another_logging",
        {
            "hydra/job_logging/evil.yaml": "version: 1\nroot: {handlers: [x]}"
            f"\nhandlers: {{x: {FACTORY}}}"
        },
        ("hydra/job_logging=evil",),
    ),
    in_experiment("environment", "hydra: {job: {env_set: {PYTHONSTARTUP: MARKER}}}"),
    in_experiment("environment_copied", "hydra: {job: {env_copy: [PATH]}}"),
    in_experiment("job_name", "hydra: {job: {name: ../../evil}}"),
    in_experiment("subdirectory", "hydra: {output_subdir: ../../evil}"),
    in_experiment("job_of_hydra", f"hydra: {{job: {{config: {TOUCH}}}}}"),
    in_experiment("runtime_of_hydra", f"hydra: {{runtime: {{choices: {{x: {TOUCH}}}}}}}"),
    Payload(
        "package_to_compose_from",
        {"other.yaml": "hydra: {searchpath: ['pkg://evil_package']}\ndevice: cpu"},
        ("--config-name=other",),
    ),
    Payload("package_on_the_command_line", {}, ("hydra.searchpath=[pkg://evil_package]",)),
    # what a multirun sweeps over
    in_experiment(
        "swept_target",
        "hydra: {mode: MULTIRUN, sweeper: {params: {model._target_: 'os.getpid,os.getcwd'}}}",
    ),
    in_experiment(
        "swept_logging",
        "hydra: {mode: MULTIRUN, sweeper: {params: "
        "{+hydra.job_logging.handlers.x.class: logging.FileHandler}}}",
    ),
    Payload(
        "swept_experiments",
        {
            "experiment/good.yaml": EXPERIMENT + "seed: 1",
            "experiment/evil.yaml": EXPERIMENT
            + f"seed: 2\nhydra: {{job_logging: {{handlers: {{file: {HANDLER}}}}}}}",
        },
        ("-m", "experiment=good,evil"),
    ),
    Payload(
        "swept_ablations",
        {"ablation/evil.yaml": f"{EXPERIMENT}model: {TOUCH}"},
        ("experiment=ablation", "group=primary", "ablation=baseline,evil"),
    ),
    # a scheduler, whose workers unpickle what they are sent
    *[
        in_study(f"cluster_{name}", text)
        for name, text in {
            "written": "monitor: {cluster: 'tcp://127.0.0.1:1'}",
            "referred": "x: 'tcp://127.0.0.1:1'\nmonitor: {cluster: '${x}'}",
            "resolved": "monitor: {cluster: '${now:tcp://127.0.0.1:1}'}",
            "resolved_late": "monitor: {cluster: '${hydra:job.name}'}",
            "elsewhere": "x: {cluster: 'tcp://127.0.0.1:1'}\nmonitor: '${x}'",
            "of_hydra": "hydra: {job: {cluster: 'tcp://127.0.0.1:1'}}\nmonitor: '${hydra:job}'",
            "swept": "hydra: {mode: MULTIRUN, "
            "sweeper: {params: {monitor.cluster: 'tcp://127.0.0.1:1'}}}",
            "swept_group": "hydra: {mode: MULTIRUN, sweeper: {params: {monitor: '{cluster: x}'}}}",
        }.items()
    ],
    # YAML and pickles
    in_experiment("yaml_tag", "model: !!python/object/apply:os.system ['touch MARKER']"),
    in_experiment("yaml_tag_new", "model: !!python/object/new:os.system ['touch MARKER']"),
    in_experiment("yaml_alias_of_itself", "model: &a {x: *a}"),
    in_experiment("deep_yaml", "model: " + "[" * 2000 + "]" * 2000),
    Payload("pickle_to_run_again", {}, ("--experimental-rerun=PICKLE",)),
    Payload("pickle_to_run_again_abbreviated", {}, ("--exp=PICKLE",)),
    # looking at a configuration builds nothing either
    in_experiment("shown", f"model: {TOUCH}", "--cfg=job", "--resolve"),
    in_experiment("helped", f"hydra: {{callbacks: {{x: {TOUCH}}}}}", "--help"),
    Payload("on_the_command_line", {}, ("model._target_=builtins.exec", "+model._args_=[1]")),
]
NAMED = {payload.name: payload for payload in PAYLOADS}
PROGRAMS = {"train": train, "evaluate": evaluate, "simulate": simulate}


class Evil:
    """Touches the marker when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def laid_out(payload, folder):
    """Write the files of a payload; return its command line and an empty folder to run in."""
    cwd, marker = folder / "cwd", folder / "marker"
    cwd.mkdir()
    (folder / "victim").touch()
    (folder / "pickle").write_bytes(pickle.dumps(Evil(marker)))
    package = folder / "evil_package"
    package.mkdir()
    (package / "__init__.py").write_text(f"x = open({str(marker)!r}, 'w')\n")
    places = {"MARKER": marker, "VICTIM": folder / "victim", "PICKLE": folder / "pickle"}

    def filled(text):
        for word, place in (places | {"CWD": cwd}).items():
            text = text.replace(word, str(place))
        return text

    for name, text in payload.files.items():
        file = folder / "theirs" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(filled(text))
    theirs = [f"--config-dir={folder / 'theirs'}"] if payload.files else []
    arguments = [*theirs, *map(filled, payload.arguments)]
    return sorted(arguments, key=lambda one: not one.startswith("-")), cwd


def is_refused(ended, folder, cwd):
    """Assert one line, an exit code, nothing executed and nothing written."""
    assert not (folder / "marker").exists(), "executed"
    assert (folder / "victim").exists(), "executed"
    assert not list(cwd.iterdir()), "written"
    assert ended.returncode in (1, 2)
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.count("\n") == 1


BY_HYDRA = ("job_of_hydra", "cluster_of_hydra")
"""Payloads that Hydra itself refuses as it composes them."""


def text_of(payload):
    """Return what a payload adds to a whole configuration, None if it does more than that."""
    name, text = next(iter(payload.files.items()), ("", ""))
    plain = text.startswith(EXPERIMENT) and payload.arguments[:1] == (f"{Path(name).parent}=evil",)
    only = len(payload.files) == 1 and set(payload.arguments[1:]) <= {"run=x"}
    others = ("!!", "&", "[[", "MULTIRUN")  # what the loader refuses before it is checked
    checked = plain and only and payload.program != "simulate" and payload.name not in BY_HYDRA
    return text if checked and not any(o in text for o in others) else None


CHECKED = [payload for payload in PAYLOADS if text_of(payload) is not None]
AS_ANOTHER = (
    *("changes__runstring", "changes__torch_load", "cluster_swept_group", "shadowed_sweeper"),
    *("another_launcher", "yaml_tag_new", "swept_logging", "expression_of_joblib"),
    *("argument_of_the_launcher", "argument_of_the_sweeper", "pickle_to_run_again_abbreviated"),
    *("changes__touch", "fleet", "launcher", "sweeper", "hydra_logging_class", "another_logging"),
    *("nested_in_swept", "swept_experiments", "package_to_compose_from", "cluster_swept"),
    *("cluster_of_hydra", "yaml_alias_of_itself", "on_the_command_line", "shown"),
)
"""Payloads that a program refuses as it does another one that it is handed by default."""
WHOLE = ("model__touch", "hydra_callback__touch", "cluster_resolved_late")
"""Payloads of `CHECKED` that are handed to a whole program by default too."""


@pytest.fixture(scope="module")
def shipped():
    """Return the configurations as shipped that take the payloads in, of each program."""
    with initialize_config_dir(version_base="1.3", config_dir=trusted.CONFIGS):
        loader = CheckedLoader(GlobalHydra.instance().config_loader().get_search_path())
        return {
            name: loader.load_configuration(name, arguments, RunMode.RUN)
            for name, arguments in (("train", []), ("evaluate", ["run=x"]))
        }


def check_with(config, text):
    """Check a configuration with a text merged into it, as Hydra's loader is to do."""
    with flag_override(config, ["struct", "readonly"], False):
        found = OmegaConf.merge(config, OmegaConf.create(text))
    trusted.check_configuration(found)
    check_typed(found, ())


@pytest.mark.parametrize("program", ["train", "evaluate"])
def test_configuration_that_sets_plain_values_is_trusted(shipped, program):
    check_with(shipped[program], "x: 1\nseed: 2\nhydra: {job: {name: mine}}")


@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(
            one,
            id=one.name,
            marks=[pytest.mark.slow] * (one.name.partition("__")[2] in SLOW),
        )
        for one in CHECKED
    ],
)
def test_payload_is_refused_by_the_checks_of_a_configuration(
    shipped, payload, tmp_path, monkeypatch
):
    monkeypatch.setenv("EVIL", "suspnet.cli.config_files.Path.touch")
    laid_out(payload, tmp_path)
    (file,) = (tmp_path / "theirs").rglob("*.yaml")
    with pytest.raises(ValueError, match=r"\w") as refused:
        check_with(shipped[payload.program], file.read_text())
    assert not isinstance(refused.value, OmegaConfBaseException)  # by ours
    assert not (tmp_path / "marker").exists(), "executed"
    assert (tmp_path / "victim").exists(), "executed"


@pytest.mark.filterwarnings(r"ignore:\s+'hydra/:UserWarning")  # a name of Hydra's own options
@pytest.mark.parametrize(
    "payload",
    [
        pytest.param(
            one,
            id=one.name,
            marks=[pytest.mark.slow]
            * (
                one.name.partition("__")[2] in SLOW
                or one.name in AS_ANOTHER
                or (one in CHECKED and one.name not in WHOLE)
            ),
        )
        for one in PAYLOADS
    ],
)
def test_payload_is_refused_before_anything_is_done(payload, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    arguments, cwd = laid_out(payload, tmp_path)
    evil = {"EVIL": "suspnet.cli.config_files.Path.touch"}
    small = SMALL if payload.program == "train" else []
    ended = typed(PROGRAMS[payload.program], *arguments, *small, cwd=cwd, **evil)
    is_refused(ended, tmp_path, cwd)


def test_there_are_many_payloads_of_distinct_names():
    assert len(NAMED) == len(PAYLOADS) >= 100


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("hydra_callback__touch", marks=pytest.mark.slow),  # a process takes seconds
        pytest.param("handler_factory", marks=pytest.mark.slow),
        pytest.param("swept_experiments", marks=pytest.mark.slow),
    ],
)
def test_payload_is_refused_in_a_process(name, tmp_path):
    arguments, cwd = laid_out(NAMED[name], tmp_path)
    is_refused(command("train.py", *arguments, *SMALL, cwd=cwd), tmp_path, cwd)


def test_every_trusted_name_is_a_class_of_ours_or_of_hydra():
    for name in trusted.CALLBACKS:
        assert callable(get_object(name))
        assert name.startswith("suspnet.")
    for name in (*trusted.SWEEPERS, trusted.LAUNCHERS[0]):
        assert get_object(name).__name__ in ("BasicSweeper", "BasicLauncher")


def test_configurations_as_shipped_use_our_resolvers_only():
    for file in Path(trusted.CONFIGS).rglob("*.yaml"):
        trusted._check_resolvers(file.name, file.read_text().replace("$$", ""))


@pytest.mark.parametrize(
    ("text", "resolvers"),
    [
        ("${now:%Y}", ["now"]),
        ("${a.${b}.c}", []),
        ("x ${${a}.create:1} y", ["${a}.create"]),
        ("${now:'${oc.env:X}'}", ["oc.env", "now"]),
        (r"\${oc.env:X}", []),
        ("${ oc.env : X }", ["oc.env"]),
    ],
)
def test_resolvers_are_found_as_omegaconf_finds_them(text, resolvers):
    assert trusted._resolvers(text) == resolvers
    with pytest.raises(
        ValueError, match=r"uses the resolver 'oc\.decode'; only changed, described, hydra"
    ):
        trusted._check_resolvers("key", "${oc.decode:1}")


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    "arguments",
    [
        ("hydra/job_logging=none", "hydra.verbose=true"),
        ("hydra/job_logging=stdout", "hydra/hydra_logging=none"),
        ("hydra/job_logging=disabled", "hydra.output_subdir=null"),
        ("hydra.run.dir=here", "hydra.job.chdir=false", "hydra.sweeper.max_batch_size=2"),
        ("experiment=table6", "model=linear", "seed=1,2"),
    ],
)
def test_what_is_documented_is_allowed(arguments):
    with initialize_config_dir(version_base="1.3", config_dir=trusted.CONFIGS):
        loader = CheckedLoader(GlobalHydra.instance().config_loader().get_search_path())
        found = loader.load_configuration("train", [*arguments], RunMode.MULTIRUN)
    assert found.model.kind in KINDS["model"]


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("arguments", "cluster"),
    [
        (["monitor.cluster=tcp://host:8786"], "tcp://host:8786"),
        (["monitor.cluster=local", "trips=a,b"], "local"),
        (["monitor.cluster=null"], None),
        ([], None),
    ],
)
def test_cluster_may_be_named_on_the_command_line(arguments, cluster):
    with initialize_config_dir(version_base="1.3", config_dir=trusted.CONFIGS):
        loader = CheckedLoader(GlobalHydra.instance().config_loader().get_search_path())
        master = loader.load_configuration("evaluate", ["run=x", *arguments], RunMode.MULTIRUN)
        job = ["run=x", *arguments[:1], "trips=a"]
        assert loader.load_sweep_config(master, job).monitor.cluster == cluster


LAUNCHED = {"n_jobs": -1, "prefer": "processes", "pre_dispatch": "2*n_jobs", "partition": None}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"n_jobs": 2, "partition": "long"}, None),
        ({"pre_dispatch": 3}, None),
        (
            {"pre_dispatch": "exit()"},
            "`hydra.launcher.pre_dispatch` must be as shipped, or a number",
        ),
        ({"partition": "a\ntouch x"}, "`hydra.launcher.partition` must be a plain word"),
        ({"partition": "${oc.env:X}"}, "uses the resolver 'oc.env'"),
        ({"setup": ["touch x"]}, "`hydra.launcher.setup` must be as shipped, or a number"),
        ({"_target_": "os.system"}, "`hydra.launcher._target_` must be one of"),
    ],
)
def test_numbers_and_words_of_a_launcher_may_be_changed(changed, message, monkeypatch):
    monkeypatch.setattr(trusted, "_shipped_launcher", lambda target: LAUNCHED)
    launcher = {"_target_": trusted.LAUNCHERS[1], **LAUNCHED, **changed}
    if message is None:
        trusted._check_launcher(launcher)
        return
    with pytest.raises(ValueError, match=message):
        trusted._check_launcher(launcher)


LAUGHS = "\n".join(["a0: &a0 [ha]", *(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]" for i in range(1, 15))])


@pytest.mark.every_value
@pytest.mark.parametrize(
    ("place", "option"),
    [
        ("vehicle/evil.yaml", "vehicle=evil"),
        ("evil.yaml", "--config-name=evil"),
        ("hydra/job_logging/evil.yaml", "hydra/job_logging=evil"),
        ("vehicle/a/b/c/d/e/evil.yaml", "vehicle=a/b/c/d/e/evil"),
    ],
)
@pytest.mark.parametrize(
    "kind", ["pipe", "endless", "laughs", "hole", "deep laughs", "tagged laughs", "interpolated"]
)
def test_configuration_that_waits_or_grows_is_refused_at_once(tmp_path, place, option, kind):
    file = tmp_path / "theirs" / place
    file.parent.mkdir(parents=True)
    {
        "pipe": lambda: os.mkfifo(file),
        "endless": lambda: file.symlink_to("/dev/zero"),
        "laughs": lambda: file.write_text(LAUGHS),
        "hole": lambda: (file.touch(), os.truncate(file, 2**40)),
        "deep laughs": lambda: file.write_text(f"x: {'[' * 25}{']' * 25}\n{LAUGHS}"),
        "tagged laughs": lambda: file.write_text(f"x: !!int 1\n{LAUGHS}"),
        "interpolated": lambda: file.write_text(f"x: {'${a}' * 100_000}"),
    }[kind]()
    done = typed(train, f"--config-dir={tmp_path / 'theirs'}", option, cwd=tmp_path)
    assert done.returncode == 1
    # Hydra takes no pipe and no device for a configuration
    assert ("evil" if kind in ("pipe", "endless") else f"{file}") in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert os.listdir(tmp_path) == ["theirs"]


@pytest.mark.parametrize("typed_too", [False, True])
def test_configuration_leads_to_no_file_elsewhere(tmp_path, typed_too):
    (tmp_path / "evil.yaml").write_text(LAUGHS)
    up = f"{'../' * 30}{tmp_path.relative_to('/')}/evil"
    option = f"vehicle={up}"
    if not typed_too:
        (tmp_path / "theirs/vehicle").mkdir(parents=True)
        (tmp_path / "theirs/vehicle/x.yaml").write_text(f"defaults:\n  - {up}\n")
        option = "vehicle=x"
    theirs = [] if typed_too else [f"--config-dir={tmp_path / 'theirs'}"]
    done = typed(train, *theirs, option, cwd=tmp_path)
    assert done.returncode == 1
    assert "leads out of the folder of configurations" in done.stderr
    assert len(done.stderr.splitlines()) == 1
