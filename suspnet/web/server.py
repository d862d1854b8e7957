"""The HTTP server: it answers also while hundreds of connections hang."""

from __future__ import annotations

import logging
import select
import socket
from typing import Any

from flask import Flask
from waitress.channel import HTTPChannel
from waitress.server import create_server

from suspnet.web.security import MAX_FORM_BYTES

MOST_CONNECTIONS = 150
"""Number of open connections above which the oldest one without a complete request is closed."""
SETTINGS = {
    "connection_limit": 2 * MOST_CONNECTIONS,  # not reached: the oldest are closed before
    "channel_timeout": 30,
    "cleanup_interval": 5,
    "max_request_header_size": 16_384,
    "max_request_body_size": 4 * MAX_FORM_BYTES,  # the pages refuse less in their own words
    "asyncore_use_poll": hasattr(select, "poll"),
}


class Channel(HTTPChannel):  # type: ignore[misc]
    """A connection that takes the place of the oldest waiting one if there are too many."""

    def __init__(self, server: Any, *arguments: Any, **named: Any) -> None:
        super().__init__(server, *arguments, **named)
        open_ones = [one for one in server.active_channels.values() if not one.will_close]
        if len(open_ones) > MOST_CONNECTIONS:
            waiting = (one for one in open_ones if one is not self and not one.requests)
            oldest = min(waiting, key=lambda one: one.creation_time, default=self)
            oldest.will_close = True  # by the loop itself, when it comes to it


def http_server(app: Flask, listening: socket.socket, threads: int) -> Any:
    """Return the server of an application at a socket that listens.

    Parameters
    ----------
    app : Flask
    listening : socket
    threads : int
        Number of answers that are made at the same time.
    """
    logging.getLogger("waitress").setLevel(logging.ERROR)  # a client that waits or goes is no fault
    server = create_server(app, sockets=[listening], threads=threads, ident="suspnet", **SETTINGS)
    server.channel_class = Channel
    return server
