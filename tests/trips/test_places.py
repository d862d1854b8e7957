"""Trips are sorted by suspension, whatever the folders are called."""

import pytest

from suspnet.ground.records import Place
from suspnet.trains.trips.grouping import TAKEN, find_groups


def write(folder, name, suspension="car 7", **where):
    folder.mkdir(parents=True, exist_ok=True)
    lines = [f"{key}: {value}" for key, value in ({"suspension": suspension} | where).items()]
    path = folder / f"{name}.yaml"
    path.write_text("\n".join(lines))
    return path


def test_mixed_folder_is_split_by_suspension_bogie_and_side(tmp_path):
    write(tmp_path, "a", bogie="leading", side="left")
    write(tmp_path, "b", bogie="leading", side="right")
    write(tmp_path, "c", bogie="trailing", side="left")
    write(tmp_path, "d", bogie="leading", side="left")
    write(tmp_path, "e", suspension="car 8")
    (tmp_path / "broken.yaml").write_text("<b>: [")
    groups = {str(g.place): [f.path.stem for f in g.manifests] for g in find_groups(tmp_path)}
    assert groups == {
        "unknown": ["broken"],
        "car 7, leading bogie, left": ["a", "d"],
        "car 7, leading bogie, right": ["b"],
        "car 7, trailing bogie, left": ["c"],
        "car 8": ["e"],
    }


def test_each_subfolder_is_read_and_what_cannot_be_is_told(tmp_path):
    for name in ("one", "two"):
        write(tmp_path / name, "trip", suspension=f"car {name}")
    write(tmp_path / "mixed", "a", suspension="x")
    write(tmp_path / "mixed", "b", suspension="y")
    write(tmp_path / ".hidden", "a")
    (tmp_path / "empty").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("seed: 0")
    (tmp_path / "notes.txt").write_text("")
    groups = {group.name: group for group in find_groups(tmp_path)}
    assert list(groups) == ["empty", "mixed_x", "mixed_y", "one", "run", "two"]
    assert groups["one"].place == Place("car one")
    assert groups["empty"].manifests == ()
    assert "holds no *.yaml file; each trip needs one" in groups["empty"].error
    assert groups["run"].error == "none of its *.yaml files (1) names a suspension"
    assert [name for name, group in groups.items() if group.error] == ["empty", "run"]


def test_subfolders_beside_manifests_are_told_not_read(tmp_path, caplog):
    write(tmp_path, "a")
    write(tmp_path / "other", "b")
    with caplog.at_level("WARNING", logger="suspnet"):
        (group,) = find_groups(tmp_path)
    assert [file.path.stem for file in group.manifests] == ["a"]
    assert "so its subfolders are not read: other" in caplog.text


def test_names_are_fit_for_folders_and_differ(tmp_path):
    texts = [
        "car 7/left",
        "car 7:left",
        "CAR 7 LEFT",
        "../..",
        "overview.html",
        "\u5217\u8eca",
        "x" * 300,
    ]
    for i, text in enumerate(texts):
        write(tmp_path, f"trip_{i}", suspension=f"'{text}'")
    names = [group.name for group in find_groups(tmp_path)]
    assert len({name.lower() for name in names}) == len(texts)
    assert not {name.lower() for name in names} & set(TAKEN)
    for name in names:
        assert 0 < len(name) < 110
        assert "/" not in name
        assert not name.startswith(".")


def test_folder_without_any_trip_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no folder .*nowhere"):
        find_groups(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"holds no \*\.yaml file"):
        find_groups(tmp_path)
