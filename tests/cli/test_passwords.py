"""The password of a PostgreSQL server reaches the server, and no file."""

import socket
import struct
import threading
from contextlib import contextmanager

import pytest
from cli_runner import typed

from suspnet.cli import evaluate, history

PASSWORD = "geheim 7@"
QUOTED = "geheim%207%40"


@contextmanager
def asking_for_a_password():
    """Serve one connection as PostgreSQL does that asks for a password in clear text."""
    got = []
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(30)

        def serve():
            with server.accept()[0] as connection:
                connection.settimeout(10)
                while b"user" not in (start := connection.recv(4096)):
                    connection.sendall(b"N")  # neither TLS nor GSSAPI
                assert start
                connection.sendall(b"R" + struct.pack("!ii", 8, 3))
                got.append(connection.recv(4096))

        thread = threading.Thread(target=serve)
        thread.start()
        yield server.getsockname()[1], got
        thread.join(30)


@pytest.mark.parametrize(
    ("form", "module"),
    [
        ("store=postgresql://kim:{}@127.0.0.1:{}/db", evaluate),
        ("store='postgresql+psycopg://kim:{}@127.0.0.1:{}/db'", evaluate),
        ('store="postgresql://kim@127.0.0.1:{1}/db?password={0}&sslmode=disable"', evaluate),
        ("postgresql://kim:{}@127.0.0.1:{}/db", history),
    ],
)
def test_a_password_reaches_the_server_and_no_file_nor_message(tmp_path, form, module):
    pytest.importorskip("psycopg")
    with asking_for_a_password() as (port, got):
        argument = form.format(QUOTED, port)
        rest = ("study=maintenance",) if module is evaluate else ("list",)
        ended = typed(module, argument, *rest, cwd=tmp_path, PGPASSWORD="another")
    assert ended.returncode == 1
    assert got == [b"p" + struct.pack("!i", 4 + len(PASSWORD) + 1) + PASSWORD.encode() + b"\0"]
    written = [path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()]
    assert bool(written) == (module is evaluate)
    seen = b"".join([*written, ended.stdout.encode(), ended.stderr.encode()])
    assert b"geheim" not in seen
