"""A reader of data files that tries what no reader may do; the file's text says what."""

import ctypes
import os
import signal
import socket
import subprocess
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from suspnet.trains.recordings.columns import Column, OpenFile


def by_c(name, *arguments):
    """Call a function of the C library, which Python does not notice; OSError if it fails."""
    found = getattr(LIBC, name)(*arguments)
    if found < 0 or (name == "system" and found):
        raise OSError(ctypes.get_errno(), f"{name} gives {found}")


LIBC = ctypes.CDLL(None, use_errno=True)


def attempts(folder: Path):
    """Return what may be tried, by name; each would leave a trace in a folder, or return text."""
    canary, secret = folder / "canary", folder / "secret"
    touch = ["/usr/bin/touch", str(canary)]
    c_canary, c_secret = str(canary).encode(), str(secret).encode()
    return {
        "system": lambda: os.system(" ".join(touch)),
        "popen": lambda: os.popen(" ".join(touch)).read(),
        "subprocess": lambda: subprocess.run(touch, check=True),
        "posix_spawn": lambda: os.posix_spawn(touch[0], touch, {}),
        "spawn": lambda: os.spawnv(os.P_WAIT, touch[0], touch),
        "exec": lambda: os.execv(touch[0], touch),
        "fork": os.fork,
        "forkpty": os.forkpty,
        "system by C": lambda: by_c("system", " ".join(touch).encode()),
        "execve by C": lambda: by_c("execl", touch[0].encode(), b"touch", c_canary, None),
        "socket": lambda: socket.socket(),
        "connection": lambda: socket.create_connection(("127.0.0.1", 9), 1),
        "server": lambda: socket.create_server(("127.0.0.1", 0)),
        "write": lambda: canary.write_text("x"),
        "append": lambda: secret.open("a").write("x"),
        "update": lambda: secret.open("r+b").write(b"x"),
        "truncate": lambda: os.truncate(secret, 0),
        "temporary file": lambda: __import__("tempfile").NamedTemporaryFile(dir=folder),
        "creat by C": lambda: by_c("creat", c_canary, 0o600),
        "unlink": secret.unlink,
        "unlink by C": lambda: by_c("unlink", c_secret),
        "rename": lambda: secret.rename(canary),
        "rename by C": lambda: by_c("rename", c_secret, c_canary),
        "mkdir": canary.mkdir,
        "mkdir by C": lambda: by_c("mkdir", c_canary, 0o700),
        "symlink": lambda: canary.symlink_to(secret),
        "link by C": lambda: by_c("link", c_secret, c_canary),
        "chmod": lambda: secret.chmod(0o777),
        "truncate by C": lambda: by_c("truncate", c_secret, 0),
        "write by C": lambda: by_c("open", c_secret, os.O_WRONLY),
        "kill by C": lambda: by_c("kill", os.getppid(), signal.SIGTERM),
        "utime": lambda: os.utime(secret, (0, 0)),
        "read": secret.read_text,
        "read by os": lambda: os.read(os.open(secret, os.O_RDONLY), 9).decode(),
        "read by C": lambda: by_c("open", c_secret, os.O_RDONLY),
        "list": lambda: str(os.listdir(folder)),
        "passwords": lambda: by_c("open", b"/etc/passwd", os.O_RDONLY),
        "kill the parent": lambda: os.kill(os.getppid(), signal.SIGTERM),
        "trace": lambda: by_c("ptrace", 16, os.getppid(), 0, 0),
        "unpickle": lambda: __import__("pickle").loads(b"cos\nsystem\n(S'true'\ntR."),
        "many files": lambda: [os.dup(0) for _ in range(1000)],
        "memory": lambda: str(np.ones(2**29)[0]),
    }


@contextmanager
def open_misbehaving(path, _=None):
    """Open a file whose text names what is tried; the words say what came of it."""
    if path.read_text() == "loop":
        while True:
            pass
    if path.read_text() == "hog":
        kept = []
        while True:
            kept.append(bytearray(2**24))
    if path.read_text() == "thread":
        thread = threading.Thread(target=time.sleep, args=(0,))
        thread.start()
        thread.join()
        import wave  # not imported before

        yield OpenFile((Column(wave.__name__),), lambda _: iter(()), "done")
        return
    if path.read_text() == "environment":
        yield OpenFile((), lambda _: iter(()), " ".join(os.environ))
        return
    try:
        found = attempts(path.parent)[path.read_text()]()
    except (OSError, MemoryError) as error:
        yield OpenFile((), lambda _: iter(()), f"refused: {type(error).__name__}")
    else:
        yield OpenFile((), lambda _: iter(()), f"done: {found}")
