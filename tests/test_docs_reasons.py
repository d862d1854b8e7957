"""docs/recordings.md: its tables hold every reason that the programs give, and no other."""

import ast
import re
import string
from pathlib import Path

import pytest

from suspnet.ground import findings
from suspnet.ground.findings import TEMPLATES
from suspnet.ground.records import TripResult
from suspnet.recordings.cleaning import KINDS
from suspnet.recordings.formats import READERS
from suspnet.recordings.manifest import MANIFEST
from suspnet.recordings.manifest_keys import CsvDialect, keys_of
from suspnet.recordings.manifest_sources import Channel
from suspnet.spectra.peaks import PeakReason

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
TELLING = (
    *(
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "suspnet/recordings").glob("*.py")
        # the texts of manifests are of the tables of keys, but for what is raised
        if path.stem not in ("manifest", "manifest_sources", "frames", "assembler", "running")
    ),
    "suspnet/spectra/plausibility.py",
    "suspnet/spectra/segments.py",
    "suspnet/estimation/healthy_trips.py",
    "suspnet/trips/check.py",
    "suspnet/estimation/direction.py",
    "suspnet/estimation/from_recording.py",
    "suspnet/estimation/from_spectra.py",
    "suspnet/estimation/trip_flags.py",
    "suspnet/estimation/lone_sensors.py",
    "suspnet/estimation/steady_parts.py",
    "suspnet/trips/grouping.py",
    "suspnet/trips/trip.py",
    "suspnet/estimation/flags.py",
    "suspnet/estimation/bogie_trips.py",
    "suspnet/estimation/swapped_sensors.py",
    "suspnet/ground/workers.py",
)
"""Modules whose every sentence is a reason."""
RAISING = (
    "suspnet/recordings/manifest.py",
    "suspnet/ground/storage.py",
    "suspnet/trips/commissionings.py",
    "suspnet/trips/fleet.py",
    "suspnet/trips/check_page.py",
    "suspnet/runs/commissioning.py",
)
"""Modules of which only what is raised or listed here is one."""
OF_FILES = (
    "suspnet/trips/file_contents.py",
    "suspnet/trips/folder_manifests.py",
    "suspnet/trips/trip_files.py",
)
"""Modules whose errors are of data files without a manifest, which `suspnet init` reports."""
OF_STREAMS = (
    "suspnet/live/replay.py",
    "suspnet/live/suspension.py",
    "suspnet/recordings/assembler.py",
    "suspnet/recordings/frames.py",
    "suspnet/recordings/running.py",
)
"""Modules whose errors are of a stream, or of a replay as one."""
ALSO = (
    "a number of m/s > 0",
    "a number >= 0",
    "a number from ",
    "reads the same data as",
    "commissioning needs",
    "the trips differ in their sensors",
)
"""Beginnings of the sentences of ``RAISING`` that are reasons though nothing raises them."""
NO_REASON = (
    "(?",  # patterns of time stamps
    "partial: ",  # words about a simulation
    "by the line ",  # where a value of a manifest is from
    "names in line ",  # how a CSV file is read
    " with byte-order mark",
    "`name` must be that of the file",  # of manifests that are written, not read
    "the time zone ",  # `time_zone` must be one like ..., says what is printed
    " m/s:  averages",  # quality of a trip
    " (and ",  # how many more there are, which the text above the tables says
    " is damaged: its ",  # of files of models, caches and runs, which are not of a trip
    " is not a suspnet file: ",
    " is damaged or not JSON",
    " is damaged or not a safetensors file",
    "`thresholds` must be",  # of model files
    "`reference` must be",
    "`misfit` must be",
    "`costs` must be",
    "`cluster` needs dask",  # a mistake in the command
    "trip %s failed",  # of the log
    "module ",  # of a wrong import
    "import sys; ",  # a program that a reader runs
    "exit code ",  # how a reader crashed, in other words
    ", or there was too little memory",
    "a formula in the file is not",  # the channel has been refused by then
    "no part is named: ",  # another reason follows
    "vehicle  cannot be commissioned as a ",  # a mistake in the command
    "its reader has ended",  # not printed: a file is opened again
    "%s holds manifests of its own",
    "\nread:0:63",  # a table of system calls
)
"""Beginnings of sentences that are none."""
DESCRIBING = ("setting", "Setting", "optional", "Format")
"""Functions whose texts are of the tables of settings and keys."""
OF_ONE_WORD = ("missing", "loose", "sample", "harmless", "late", "empty")
"""Kinds of reasons that are one word, which may be another text too."""
VARIANTS = (
    "gain",
    "hold-same-samples",
    "left-sensor",
    "needs-rate-but",
    "right-weaker",
    "runs-forward",
    "two-on-right",
)
"""Kinds that say the same as another one of which an example is in the tables."""
FEWEST_LETTERS = 6
"""A sentence of the code with fewer fixed letters fits too many reasons."""

LEAST_SHARE = 0.2
"""Least share of the letters of a reason that one sentence of the code makes; others are names."""


def fixed_and_variable(node):
    """Return a text of the code with None for each part that is put in when it is printed."""
    if isinstance(node, ast.Constant):
        return [node.value]
    return [part.value if isinstance(part, ast.Constant) else None for part in node.values]


def texts_of(node):
    """Return what a text of the code, or the kind of a finding, says: see `fixed_and_variable`."""
    kind = node.value if isinstance(node, ast.Constant) else getattr(node, "id", "")
    kind = getattr(findings, kind, kind) if kind.isupper() else kind
    if kind in VARIANTS:
        return []
    if kind not in TEMPLATES or not ("-" in kind or kind in OF_ONE_WORD):
        return [fixed_and_variable(node)]
    found = []
    for text, name, *_ in string.Formatter().parse(TEMPLATES[kind][-1]):
        found += [text] * bool(text) + [None] * (name is not None)
    return [found]


def sentences(file, least_blanks):
    """Return the texts of three words and more of a module, docstrings left out."""
    tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
    nodes, inner = list(ast.walk(tree)), set()
    for node in nodes:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            inner.add(id(node.value))
        elif isinstance(node, ast.JoinedStr):
            inner |= {id(part) for part in node.values}
        elif isinstance(node, ast.Call) and getattr(node.func, "id", "") in DESCRIBING:
            inner |= {id(part) for part in ast.walk(node)}  # what a setting or key means
    if file in RAISING:
        told = {id(one) for n in nodes if isinstance(n, ast.Raise) for one in ast.walk(n)}
    found = []
    for node in nodes:
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        is_text |= isinstance(node, ast.Name) and node.id == "WITHOUT_SENSORS"
        if id(node) in inner or not (is_text or isinstance(node, ast.JoinedStr)):
            continue
        for parts in texts_of(node):
            words = "".join(part or "" for part in parts)
            if file in RAISING and id(node) not in told and not words.startswith(ALSO):
                continue
            if "".join(part or "x" for part in parts).count(" ") < least_blanks:
                continue
            if n_letters(parts) >= FEWEST_LETTERS and not words.removeprefix(": ").startswith(
                NO_REASON
            ):
                found.append(parts)
    return found


def n_letters(parts):
    return sum(char.isalpha() for part in parts if part for char in part)


def pattern(parts):
    """Return what a text of the code looks like when it is printed."""
    if parts and parts[0] is None:  # what stands in front is not in the tables
        parts = [*parts[1:]]
        if parts and parts[0] is not None:
            parts[0] = parts[0].removeprefix(": ")
    return re.compile("".join(".*?" if part is None else re.escape(part) for part in parts))


def all_sentences(least_blanks):
    return [part for file in (*TELLING, *RAISING) for part in sentences(file, least_blanks)]


def table_reasons():
    """Return the first cell of each row of the tables of reasons, without its back-quotes."""
    rows = []
    for block in re.findall(r"<!-- reasons -->\n(.*?)<!-- end of reasons -->", PAGE, re.DOTALL):
        _, line, *lines = block.splitlines()
        assert line == "|---|---|---|"
        for row in lines:
            match = re.fullmatch(r"\| ``(.+?)`` \| (.*?) ?\| (.*?) ?\|", row)
            assert match, row
            assert "|" not in match[1] + match[2] + match[3], row
            rows.append(match[1].strip())
    return rows


REASONS = table_reasons()


def test_every_sentence_of_the_code_stands_in_a_table():
    missing = [parts for parts in all_sentences(2) if not any(map(pattern(parts).search, REASONS))]
    assert missing == []


def test_every_reason_of_the_tables_is_one_of_the_code():
    patterns = [(pattern(parts), n_letters(parts)) for parts in all_sentences(1)]
    for reason in REASONS:
        most = max((n for one, n in patterns if one.search(reason)), default=0)
        assert most >= LEAST_SHARE * sum(map(str.isalpha, reason)), reason


def test_every_module_that_refuses_or_flags_a_trip_is_looked_at():
    looked_at = {*TELLING, *RAISING, *OF_FILES, *OF_STREAMS}
    for path in (ROOT / "suspnet").rglob("*.py"):
        code = path.read_text(encoding="utf-8")
        if re.search(
            r"raise (?:TripError|NoEstimateError|MissingFeaturesError)\b|\.with_kind\(", code
        ):
            assert path.relative_to(ROOT).as_posix() in looked_at, path


def test_no_reason_stands_twice_and_there_are_many():
    assert len(REASONS) == len(set(REASONS)) > 100


def test_all_kinds_of_faults_and_of_missing_peaks_are_named():
    for kind in KINDS:
        assert any(f": {kind} " in reason for reason in REASONS), kind
    for reason in PeakReason:
        assert not reason or f"`{reason.name.lower().replace('_', ' ')}`" in PAGE


@pytest.mark.parametrize("keys", [MANIFEST, keys_of(Channel), keys_of(CsvDialect)])
def test_tables_of_keys_are_the_schema_of_manifests(keys):
    (table,) = (
        one.splitlines()[2:]
        for one in re.findall(r"(?<=\n\n)\| key \| type .*?(?=\n\n)", PAGE, re.DOTALL)
        if f"| `{next(iter(keys))}` |" in one
    )
    assert sorted(table) == sorted(key.row(name) for name, key in keys.items())


def test_every_column_of_the_tables_of_trips_is_named():
    columns = TripResult("trip", "trip.yaml").row(("k_p",))
    page = (ROOT / "docs" / "trips.md").read_text(encoding="utf-8")
    page = page.replace(
        "with `_low`, `_high` and `_healthy`",
        "`k_p_n_per_m_low` `k_p_n_per_m_high` `k_p_n_per_m_healthy`",
    )
    assert [name for name in columns if f"`{name}`" not in page] == []


def test_every_suffix_has_a_row():
    (table,) = re.findall(r"^\| suffix .*?\n\n", PAGE, re.DOTALL | re.MULTILINE)
    assert set(re.findall(r"`(\.\w+)`", table)) == set(READERS)
