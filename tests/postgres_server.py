"""A PostgreSQL server of the tests' own, from the programs of the system, if they are there."""

import atexit
import ctypes
import functools
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PR_SET_PDEATHSIG = 1
"""Number of an option of Linux, in sys/prctl.h."""
START_S = 60.0
"""Longest time until the server answers, [s]."""
CLOSED = ("listen_addresses=",)
"""Settings of a server that no network reaches."""
UNSAFE = (*CLOSED, "fsync=off", "full_page_writes=off", "synchronous_commit=off")
"""Settings of such a server whose data outlive no crash."""


def programs():
    """Return the folder of initdb and postgres, or None."""
    found = shutil.which("initdb")
    places = [Path(found).resolve().parent] if found else []
    places += sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)
    return next((p for p in places if all((p / n).is_file() for n in ("initdb", "postgres"))), None)


@functools.cache
def url(given=UNSAFE):
    """Return the URL of a database of a server that ends with this process; None without one."""
    place = programs()
    if place is None:
        return None
    folder = Path(tempfile.mkdtemp(prefix="suspnet_postgres_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    user = {"user": _plain_user(folder)} if hasattr(os, "getuid") and os.getuid() == 0 else {}
    options = {"cwd": folder, "stdout": subprocess.DEVNULL, **user}
    new = ["--auth=trust", "--username=suspnet", "--no-sync", "--no-locale", "--encoding=UTF8"]
    log = folder / "errors"
    with log.open("wb") as errors:
        subprocess.run(
            [place / "initdb", "-D", folder / "data", *new], check=True, stderr=errors, **options
        )
        settings = [word for one in given for word in ("-c", one)]
        server = subprocess.Popen(
            [place / "postgres", "-D", folder / "data", "-k", folder, *settings],
            stderr=errors,
            preexec_fn=_end_with_parent,
            **options,
        )
    atexit.register(_end, server)
    deadline = time.monotonic() + START_S
    while "ready to accept connections" not in log.read_text():
        if server.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(log.read_text())
        time.sleep(0.05)
    return f"postgresql://suspnet@/postgres?host={folder}"


def _plain_user(folder):
    """Give a folder to a user whom PostgreSQL serves, not root, and return the name."""
    import pwd  # not everywhere

    names = {entry.pw_name for entry in pwd.getpwall()}
    name = next(name for name in ("postgres", "nobody") if name in names)
    shutil.chown(folder, name)
    return name


def _end_with_parent():
    """Ask Linux to end this process with its parent, which may be killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGQUIT)


def _end(server):
    """End the server and its connections at once."""
    server.send_signal(signal.SIGQUIT)
    server.wait(30)
