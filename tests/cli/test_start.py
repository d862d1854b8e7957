"""A signal that comes while a program is imported ends it at once."""

import os
import signal
import subprocess
import sys
import time

import pytest
from cli_runner import ROOT

pytestmark = pytest.mark.skipif(os.name != "posix", reason="signals are those of POSIX")


@pytest.mark.parametrize(
    "number",  # SIGTERM at the start of a program: test_serve_program.py
    [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)],
)
def test_signal_while_a_program_is_imported_ends_it_without_a_word(tmp_path, number):
    (tmp_path / "torch.py").write_text(  # stands for what takes seconds
        f"import pathlib, time\npathlib.Path({str(tmp_path / 'begun')!r}).touch()\ntime.sleep(60)\n"
    )
    process = subprocess.Popen(
        [sys.executable, ROOT / "evaluate.py", "run=x"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        stderr=subprocess.PIPE,
        text=True,
    )
    last = time.monotonic() + 60
    while not (tmp_path / "begun").exists() and time.monotonic() < last:
        time.sleep(0.02)
    process.send_signal(number)
    _, words = process.communicate(timeout=60)
    assert (words, process.returncode) == ("", -number)
