"""The examples run by themselves, on public names, leave nothing behind and are readable."""

import ast
import importlib
import json
import runpy
import shutil
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("plot_*.py"))
HAS_SHELF = any((p / "shared" / "real" / "shelf").is_dir() for p in EXAMPLES.parents)
"""Whether the measured records are there that plot_rig.py reads."""
WIDEST_INCHES = 5.0
"""A page on a phone, 390 px wide, shows text of 10 points in a wider figure too small."""


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example in an empty folder; return what it printed and its figures."""
    plt.switch_backend("Agg")
    monkeypatch.setattr(plt, "show", lambda: None)
    work, temporary = tmp_path / "work", tmp_path / "temporary"
    for folder in (work, temporary):
        folder.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))

    def run(script):
        plt.close("all")
        runpy.run_path(str(script), run_name="__main__")
        # torch keeps a folder of its own among the temporary ones
        left = [*work.iterdir(), *temporary.glob("tmp*")]
        assert not left
        return capsys.readouterr().out, [plt.figure(number) for number in plt.get_fignums()]

    with plt.rc_context():
        yield run
    plt.close("all")


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_example_runs_without_a_warning_and_draws_what_a_phone_can_show(script, run):
    if script.stem == "plot_rig" and not HAS_SHELF:
        pytest.skip("../shared/real/shelf is absent")
    printed, figures = run(script)
    assert printed
    assert 1 <= len(figures) <= 2
    for figure in figures:
        figure.canvas.draw()
        assert figure.get_figwidth() <= WIDEST_INCHES
        for axes in figure.axes:
            for axis in (axes.xaxis, axes.yaxis):
                shown = any(t.get_visible() and t.get_text() for t in axis.get_ticklabels())
                assert axis.get_label_text() or not shown


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_examples_import_public_names_only(script):
    for node in ast.walk(ast.parse(script.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("suspnet") for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module.startswith("suspnet"):
            public = importlib.import_module(node.module).__all__
            assert {alias.name for alias in node.names} <= set(public)


def test_notebook_is_made_of_its_script(tmp_path):
    notebooks = pytest.importorskip("sphinx_gallery.notebook", reason="needs the extra docs")
    notebook = EXAMPLES / "plot_recording.ipynb"
    copy = shutil.copy(notebook.with_suffix(".py"), tmp_path)
    notebooks.python_to_jupyter_cli([copy])
    made, kept = (
        json.loads(file.read_text(encoding="utf-8"))["cells"]
        for file in (Path(copy).with_suffix(".ipynb"), notebook)
    )
    words = f"run sphinx_gallery_py2jupyter examples/{notebook.stem}.py"
    assert made == kept, words
