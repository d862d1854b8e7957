"""Folders of results are marked, and no other one is taken for one."""

import pytest

from suspnet.ground.own_files import MARKER, begin, discard, free_name
from suspnet.ground.storage import write_atomically


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# property


def test_folder_that_is_new_or_empty_begins_and_results_go_on(tmp_path):
    assert not begin(tmp_path / "a" / "new")
    assert not begin(tmp_path / "a" / "new")
    write_atomically(tmp_path / "a" / "new" / "sub" / "file", "1")
    assert begin(tmp_path / "a" / "new")
    assert names(tmp_path / "a" / "new") == ["sub", MARKER]


def test_folders_below_a_marked_one_are_ours_until_it_is_finished(tmp_path):
    begin(tmp_path)
    assert not begin(tmp_path / "sub")
    write_atomically(tmp_path / "sub" / "file", "1")
    assert begin(tmp_path / "sub")
    discard(tmp_path)
    with pytest.raises(FileExistsError, match="suspnet did not write it here"):
        begin(tmp_path / "sub")


def test_free_name_is_that_of_no_file(tmp_path):
    assert free_name(tmp_path / "train.log") == tmp_path / "train.log"
    (tmp_path / "train.log").touch()
    (tmp_path / "train_2.log").symlink_to("nowhere")
    assert free_name(tmp_path / "train.log") == tmp_path / "train_3.log"


# failure


@pytest.mark.parametrize("name", ["mine", ".hidden", "sub/mine", MARKER])
def test_folder_with_another_file_is_refused_and_left_unchanged(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    with pytest.raises(FileExistsError, match="suspnet did not write it here: give a new folder"):
        begin(tmp_path)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [tmp_path / name]


@pytest.mark.parametrize("target", ["elsewhere", "nowhere"])
def test_link_in_a_marked_folder_is_refused(tmp_path, target):
    (tmp_path / "elsewhere").mkdir()
    begin(tmp_path / "run")
    (tmp_path / "run" / "figures").symlink_to(tmp_path / target)
    with pytest.raises(FileExistsError, match="a link: give a new folder"):
        begin(tmp_path / "run")


def test_marker_behind_a_link_is_none(tmp_path):
    begin(tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / MARKER).symlink_to(tmp_path / "a" / MARKER)
    with pytest.raises(FileExistsError, match="suspnet did not write it here"):
        begin(tmp_path / "b")


def test_writing_replaces_a_link_and_not_the_file_that_it_leads_to(tmp_path):
    (tmp_path / "victim").write_text("mine")
    (tmp_path / "file").symlink_to(tmp_path / "victim")
    write_atomically(tmp_path / "file", "1")
    assert (tmp_path / "victim").read_text() == "mine"
    assert not (tmp_path / "file").is_symlink()
