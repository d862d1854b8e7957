"""A ledger knows the files that were written in its folder, and no other ones."""

import json

import pytest

from suspnet.ground import ledger
from suspnet.ground.ledger import LEDGER, begin, free_name, remove
from suspnet.ground.storage import write_atomically

MINE = "suspnet did not write it here, or it was changed since"


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# property


def test_folder_that_is_new_or_empty_begins_and_results_go_on(tmp_path):
    assert not begin(tmp_path / "a" / "new")
    assert not begin(tmp_path / "a" / "new")
    write_atomically(tmp_path / "a" / "new" / "sub" / "file", "1")
    assert begin(tmp_path / "a" / "new")
    assert names(tmp_path / "a" / "new") == ["sub", LEDGER]


def test_what_was_written_is_replaced_and_removed_and_nothing_else(tmp_path):
    begin(tmp_path)
    ours, other = tmp_path / "ours", tmp_path / "other"
    for text in ("1", "2", "1"):
        write_atomically(ours, text)
    other.write_text("mine")
    for act in (lambda: write_atomically(other, "2"), lambda: begin(tmp_path)):
        with pytest.raises(FileExistsError, match=MINE):
            act()
    remove(other)
    assert other.read_text() == "mine"
    write_atomically(other, "2", force=True)
    assert begin(tmp_path)
    remove(ours)
    remove(ours)
    assert names(tmp_path) == ["other", LEDGER]
    ours.symlink_to("other")  # whose content is listed, but not as that of this name
    remove(ours)
    with pytest.raises(FileExistsError, match=MINE):
        write_atomically(ours, "2")
    assert ours.is_symlink()


def test_ledger_of_a_folder_above_knows_its_subfolders(tmp_path):
    begin(tmp_path)
    assert not begin(tmp_path / "sub")
    write_atomically(tmp_path / "sub" / "file", "1")
    assert begin(tmp_path / "sub")
    assert names(tmp_path / "sub") == ["file"]
    ledger.discard(tmp_path / "sub")
    assert names(tmp_path) == ["sub", LEDGER]
    ledger.discard(tmp_path)
    with pytest.raises(FileExistsError, match=MINE):
        begin(tmp_path / "sub")


def test_files_that_grow_may_be_there_and_are_not_ours(tmp_path):
    begin(tmp_path)
    for name in ("train.log", "events.out.tfevents.1.host"):
        (tmp_path / name).write_text("1")
        assert begin(tmp_path)
        with pytest.raises(FileExistsError, match=MINE):
            write_atomically(tmp_path / name, "2")
        remove(tmp_path / name)
        assert (tmp_path / name).read_text() == "1"
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_text("1")
    assert begin(tmp_path)
    (tmp_path / ".hydra" / "link").symlink_to("config.yaml")
    with pytest.raises(FileExistsError, match=MINE):
        begin(tmp_path)


def test_temporary_file_of_a_killed_program_may_be_there(tmp_path):
    begin(tmp_path)
    ledger.note(tmp_path / "sub" / "model.json", b"{}", "0123abcd")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / ".model.json.0123abcd").write_text("{")
    assert begin(tmp_path)
    write_atomically(tmp_path / "sub" / "model.json", "{}")
    assert (tmp_path / "sub" / ".model.json.0123abcd").read_text() == "{"
    (tmp_path / "sub" / ".model.json.11111111").write_text("{")
    with pytest.raises(FileExistsError, match=MINE):
        begin(tmp_path)


def test_free_name_is_that_of_no_file(tmp_path):
    assert free_name(tmp_path / "train.log") == tmp_path / "train.log"
    (tmp_path / "train.log").touch()
    (tmp_path / "train_2.log").symlink_to("nowhere")
    assert free_name(tmp_path / "train.log") == tmp_path / "train_3.log"


def test_empty_file_is_not_ours_but_what_hydra_left(tmp_path):
    begin(tmp_path)
    for name in (ledger.MULTIRUN, "error.txt"):
        write_atomically(tmp_path / name, "1").write_text("")
    write_atomically(tmp_path / ledger.MULTIRUN, "2")
    remove(tmp_path / "error.txt")
    assert (tmp_path / "error.txt").exists()


# failure


@pytest.mark.parametrize("content", ["mine", '["0", "a", "b"]', "[]\n[]"])
def test_file_of_the_ledgers_name_without_its_head_is_somebody_elses(tmp_path, content):
    (tmp_path / LEDGER).write_text(content)
    with pytest.raises(FileExistsError, match=MINE):
        begin(tmp_path)
    write_atomically(tmp_path / "file", "1")
    assert (tmp_path / LEDGER).read_text() == content


def test_ledger_behind_a_link_is_none(tmp_path):
    begin(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / LEDGER).symlink_to(tmp_path / "a" / LEDGER)
    with pytest.raises(FileExistsError, match=MINE):
        begin(tmp_path / "b")
    before = (tmp_path / "a" / LEDGER).read_bytes()
    write_atomically(tmp_path / "b" / "file", "1")
    assert (tmp_path / "a" / LEDGER).read_bytes() == before


def test_forged_lines_give_nothing_away(tmp_path):
    begin(tmp_path / "run")
    victim = tmp_path / "victim"
    victim.write_text("known")
    (tmp_path / "run" / "own").write_text("unknown")
    sha256 = "3df63b7acb0522da685dad5fe84b81fdd7b25264bc97c8ac4c5e1cd3a0c4b8c1"
    lines = [
        [sha256, str(victim), "x"],
        [sha256, "../victim", "x"],
        [sha256, "own", "x"],
        [[], "own"],
    ]
    with (tmp_path / "run" / LEDGER).open("a") as stream:
        stream.writelines(f"{json.dumps(line)}\n" for line in lines)
    with pytest.raises(FileExistsError, match=MINE):
        write_atomically(tmp_path / "run" / "own", "x")
    for path in (victim, tmp_path / "run" / "own", tmp_path / "run" / ".." / "victim"):
        remove(path)
        assert path.exists()
