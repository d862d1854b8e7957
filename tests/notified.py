"""A store with alarms, and local servers that receive messages about them."""

import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from trip_records import trip

from suspnet.ground.parameters import Cause, Severity
from suspnet.ground.records import Place
from suspnet.trains.history import History
from suspnet.trains.maintenance.alarms import Alarm

KEY = "whsec_" + "c3VzcG5ldCBzdXNwbmV0IHN1c3BuZXQ="
FIRST, SECOND = Place("bogie 1, left"), Place("x", "leading", train="4", car="7")
VEHICLE = "AM96 217"
ACT = Alarm("k_p", Cause.LIMIT, Severity.ACT, 1e4, words="far\r\nBcc: evil@example.org below")
NOTICE = Alarm("c_s", Cause.CHANGE, Severity.NOTICE, 1e4, words="fell")


def fill(path):
    with History(path) as store:
        store.write([trip(0, with_curves=False, place=one) for one in (FIRST, SECOND)])
        store.keep_alarms(VEHICLE, FIRST, [ACT])
        store.keep_alarms(VEHICLE, SECOND, [NOTICE])
    return path


@contextmanager
def receiving(on_post=lambda n: 204, context=None):
    """Serve HTTP, or HTTPS with a `context`; `on_post` returns the status of the n-th request.

    Yields
    ------
    str, list of (headers, body)
        The address and what was received.
    """
    got = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = self.rfile.read(int(self.headers["Content-Length"]))
            got.append((dict(self.headers), body))
            self.send_response(on_post(len(got)))
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    if context:
        server.socket = context.wrap_socket(server.socket, server_side=True)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/hook", got
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def rules_file(path, channels, recipients):
    import json  # YAML too

    path.write_text(json.dumps({"channels": channels, "recipients": recipients}))
    return path


def notify_forever(store, rules, lease_s):
    """Run in a process of its own, as `notify --follow` does, with quick looks."""
    from suspnet.depot.live import notifier
    from suspnet.trains.history import outbox

    outbox.LEASE_S, notifier.LOOK_S = lease_s, 0.05
    with History(store) as history:
        notifier.Notifier(history, notifier.read_rules(rules)).run()
