"""Random requests to the API, by its own description: python benchmarks/api_requests.py [N].

Schemathesis makes at least N requests (10 000 by default), good and bad ones, to the server that
suspnet-serve runs, with all its checks: no answer is an error of the program, each has a status,
a type and content that the description names, bad requests are refused, good ones are not. It
prints what it found, and the number of answers of each status as the server counted them.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from served_fleet import FAILED, fill, name_of, served

from suspnet.depot.web.access import Access

TOKEN = "a-token-of-programs-for-tests"
EACH = 60
"""Requests of each of the operations in the phase of random ones."""


def main(least: int) -> None:
    """Run schemathesis until enough requests were sent; exit with 1 if a check failed."""
    answers: Counter[int] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        path = fill(Path(folder) / "fleet.db")
        with served(path, 3600.0, Access(token=TOKEN)) as (site, refresher):
            while not refresher.board.view.is_complete:
                time.sleep(0.05)
            app = refresher.app
            app.after_request(lambda found: answers.update([found.status_code]) or found)
            name = name_of(refresher.board.view, FAILED)
            config = Path(folder) / "schemathesis.toml"
            config.write_text(f'[parameters]\n"path.id" = "{name}"\n')
            program = Path(sys.executable).with_name("schemathesis")
            command = [program, "--config-file", config, "run", f"{site}/api/v1/openapi.json"]
            command += ["--checks", "all", "--phases", "examples,coverage,fuzzing"]
            command += ["--header", f"Authorization: Bearer {TOKEN}", "--no-color"]
            code, seed, begin = 0, 1, time.monotonic()
            while answers.total() < least and not code:
                numbers = ["--seed", str(seed), "--max-examples", str(EACH)]
                code = subprocess.run([*command, *numbers], cwd=folder, check=False).returncode
                seed += 1
            seconds = time.monotonic() - begin
    print(f"{answers.total()} requests in {seconds:.0f} s, answers {dict(sorted(answers.items()))}")
    sys.exit(code)


if __name__ == "__main__":
    assert shutil.which("schemathesis", path=str(Path(sys.executable).parent)), "pip install it"
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
