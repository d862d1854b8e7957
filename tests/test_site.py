"""The documentation's pages, the API and what the packages say of themselves are complete."""

import re
import tomllib
from pathlib import Path

import yaml

import suspnet

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


def listed(page, directive):
    """Return the entries of all of a page's directives of one name."""
    text = (DOCS / page).read_text(encoding="utf-8")
    found = []
    for block in re.findall(rf"{directive}\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        found += [line.strip() for line in block.splitlines() if not line.strip().startswith(":")]
    return [entry for entry in found if entry]


def test_every_page_is_in_one_toctree():
    pages = [path.stem for path in DOCS.glob("*.md") if path.stem != "index"]
    entries = listed("index.md", r"```\{toctree\}")
    assert sorted(entry for entry in entries if "/" not in entry) == sorted(pages)


def test_every_public_name_has_a_page():
    entries = [name for name in listed("api.md", r"\.\. autosummary::") if "." not in name]
    constants = [name for name in suspnet.__all__ if name.isupper() and name not in entries]
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    assert all(f"`{name}`" in text for name in constants)
    assert sorted(entries + constants) == sorted(suspnet.__all__)


def test_citation_names_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["version"] == suspnet.__version__
    assert citation["license"] == project["license"]
    assert citation["keywords"] == project["keywords"]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)


def test_changelog_begins_with_this_version():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## \[(.*?)\]", text, re.MULTILINE)[0] == suspnet.__version__


def test_workflow_checks_each_python_that_is_claimed():
    workflow = yaml.safe_load((ROOT / ".github/workflows/checks.yml").read_text(encoding="utf-8"))
    (job,) = workflow["jobs"].values()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    prefix = "Programming Language :: Python :: "
    claimed = {c.removeprefix(prefix) for c in project["classifiers"] if c.startswith(prefix)}
    assert set(job["strategy"]["matrix"]["python"]) == claimed - {"3 :: Only"}
    assert job["steps"][-1] == {"run": "bash .ci/run"}
    assert "Operating System :: POSIX :: Linux" in project["classifiers"]
    assert job["runs-on"].startswith("ubuntu")


def test_every_folder_of_the_package_is_in_the_wheel():
    setuptools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "setuptools"
    ]
    folders = {
        ".".join(file.parent.relative_to(ROOT).parts) for file in ROOT.glob("suspnet/**/*.py")
    }
    assert set(setuptools["packages"]) == folders | {"suspnet.configs"}
    for file in (ROOT / "suspnet").rglob("*"):
        if file.is_file() and file.suffix not in (".py", ".pyc"):
            above = [".".join(one.parts) for one in file.relative_to(ROOT).parents]
            package = next(name for name in above if name in setuptools["packages"])
            patterns = setuptools["package-data"].get(package, [])
            assert any(file.match(pattern) for pattern in patterns), file
