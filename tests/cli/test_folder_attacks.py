"""No name or folder of somebody else's makes a program remove or replace a file.

A home with files of a user lies beside the folder in which the programs run. Both are compared
with what they were, name by name and byte by byte.
"""

import hashlib
import os
import re
import shutil
from dataclasses import dataclass

import pytest
from cli_runner import SMALL, typed

from suspnet.cli import check, evaluate, history, replay, simulate, train

TRAIN = ["model=linear", "data.n_calibrate=null"]
TRAIN += [one for one in SMALL if not one.startswith("data.n_calibrate")]
SIMULATE = ["fleet.n_trips=1", "fleet.minutes=2", "progress=false"]
EVALUATE = ["run=no_run", "trips=no_trips"]
REPLAY = ["trips=no_trips"]
PROGRAMS = {
    "train": (train, TRAIN),
    "evaluate": (evaluate, EVALUATE),
    "simulate": (simulate, SIMULATE),
    "replay": (replay, REPLAY),
    "check": (check, ["no_trips"]),
    "history": (history, []),
}
USERS = {
    ".bashrc.original": "alias",
    ".config.yaml.0123abcd": "mine",
    "config.yaml": "mine: true",
    "metrics.json": "{}",
    "model.json": "{}",
    "train.log": "mine",
    "check.json": "{}",
    "unfinished.json": '{"made_from": "x"}',
    "sub/error.txt": "mine",
    "events.out.tfevents.1.host.2.3": "events of another project",
    ".hydra/config.yaml": "mine",
    "empty": "",
}
"""Files of a user with the names of what the programs write, or once removed."""


@dataclass(frozen=True)
class Attack:
    """What is tried: what is laid out, and a command line.

    HOME stands for the user's folder, LINK for a link to it.
    """

    name: str
    arguments: tuple[str, ...] = ()
    program: str = "train"
    words: str = ""
    small: bool = False


def tree(folder):
    """Return all that is below a folder, but for results in new folders of the programs."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if name.startswith(("cwd/outputs/", "cwd/.cache")) or name == "cwd/outputs":
            continue
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        else:
            found[name] = "folder"
    return found


def lay_out(attack, folder):
    """Write the user's files and the attacker's; return the command line."""
    home, cwd = folder / "home", folder / "cwd"
    for where in (home, home / "deep" / "er"):
        for name, text in USERS.items():
            (where / name).parent.mkdir(parents=True, exist_ok=True)
            (where / name).write_text(text)
    cwd.mkdir()
    (folder / "link").symlink_to(home)
    (cwd / "here").symlink_to(home)
    places = {"HOME": str(home), "LINK": str(folder / "link")}

    def filled(text):
        return re.sub("HOME|LINK", lambda word: places[word[0]], text)

    return [*map(filled, attack.arguments), *PROGRAMS[attack.program][1]]


def is_harmless(attack, folder):
    """Run an attack and assert that it is refused in one line and nothing has changed."""
    given = lay_out(attack, folder)
    before = tree(folder)
    cwd = folder / ("home" if attack.name.startswith("in_home") else "cwd")
    ended = typed(PROGRAMS[attack.program][0], *given, cwd=cwd)
    after = tree(folder)
    assert before == {name: after.get(name) for name in before}, "removed or replaced"
    assert after == before, "written elsewhere"
    assert ended.returncode == 1, ended.stdout + ended.stderr
    assert [line[:7] for line in ended.stderr.splitlines()] == ["error: "], ended.stderr
    assert attack.words in ended.stderr


NAMED = [
    *[
        Attack(f"{key}_{place}", (*(("-m", "seed=1,2") if "sweep" in key else ()),
               f"{key}={place}"), words="suspnet did not write it here", small=place == "HOME")
        for key in ("hydra.run.dir", "hydra.sweep.dir", "resume")
        for place in ("HOME", "LINK")
    ],
    Attack("in_home", ("hydra.run.dir=.",), words="suspnet did not write it here", small=True),
    Attack("in_home_resume", ("resume=.",)),
    Attack("job", ("job=../../home",)),
    Attack("evaluate", ("resume=LINK",), program="evaluate"),
    Attack("out", ("out=HOME",), program="simulate", small=True),
]  # fmt: skip
ALL = {a.name: a for a in NAMED}


def chosen(small):
    return [
        pytest.param(attack, id=name, marks=() if attack.small else pytest.mark.slow)
        for name, attack in ALL.items()
        if attack.small or not small
    ]


@pytest.mark.representatives(5)
@pytest.mark.parametrize("attack", chosen(small=False))
def test_attack_is_refused_in_one_line_and_changes_nothing(attack, tmp_path):
    is_harmless(attack, tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Return a folder in which a training ended."""
    folder = tmp_path_factory.mktemp("ours")
    ended = typed(train, *TRAIN, "hydra.run.dir=run", cwd=folder)
    assert ended.returncode == 0, ended.stderr
    return folder / "run"


def states(folder):
    """Return inode, size and times of change of all that is in a folder."""
    found = {path: path.lstat() for path in folder.rglob("*")}
    return {path: (s.st_ino, s.st_size, s.st_mtime_ns, s.st_ctime_ns) for path, s in found.items()}


def linked(path):
    path.unlink(missing_ok=True)
    path.symlink_to(path.parent)


@pytest.mark.parametrize("name", ["config.yaml", "figures"])
@pytest.mark.parametrize("given", ["resume=run", "hydra.run.dir=run"])
def test_links_in_a_run_are_refused(trained, tmp_path, name, given):
    run = tmp_path / "cwd" / "run"
    shutil.copytree(trained, run)  # a copy of a run is a run
    linked(run / name)
    before = states(run)
    ended = typed(train, *TRAIN, given, cwd=run.parent)
    assert states(run) == before
    assert (ended.returncode, ended.stderr.count("\n")) == (1, 1)
    assert ended.stderr == f"error: run/{name}: a link: give a new folder\n"


def test_same_command_again_replaces_what_it_wrote(trained, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    kept = {path for path in run.rglob("*") if path.name.endswith(".log") or "events" in path.name}
    bytes_before = {path: path.read_bytes() for path in kept | {run / "model.safetensors"}}
    ended = typed(train, *TRAIN, "hydra.run.dir=run", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert {path: path.read_bytes() for path in bytes_before} == bytes_before
    assert len(list(run.glob("train*.log"))) == 2
    other = typed(train, *TRAIN, "seed=3", "hydra.run.dir=run", cwd=tmp_path)
    assert other.returncode == 1
    assert other.stderr == (
        f"error: {run} holds a finished run of other settings; give another folder\n"
    )


def test_output_of_check_and_export_goes_to_folders_of_their_own(tmp_path):
    lay_out(Attack("home"), tmp_path)
    (tmp_path / "trips").mkdir()
    (tmp_path / "trips" / "trip_1.yaml").write_text("vehicle: 1")
    before = tree(tmp_path)
    ended = typed(check, "trips", "-o", "home", "--no-pictures", cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: home/.bashrc.original: suspnet did not write it here")
    assert tree(tmp_path) == before
    for _ in range(2):
        ended = typed(check, "trips", "-o", "new", "--no-pictures", cwd=tmp_path)
        assert ended.returncode == 1
        assert "-> new/check.html" in ended.stdout
    history.History(str(tmp_path / "fleet.db")).close()
    before = tree(tmp_path)
    ended = typed(history, "fleet.db", "export", "home", cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: home/.bashrc.original: suspnet did not write it here")
    assert tree(tmp_path) == before
