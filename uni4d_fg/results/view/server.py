"""The web server of the viewer: its address, and its end."""

from __future__ import annotations

import contextlib
import io
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from uni4d_fg.errors import ConfigError
from uni4d_fg.optional import import_viser

DEFAULT_HOST = "127.0.0.1"
DEFAULT_PORT = 8080


def check_address(host: str, port: int) -> None:
    """Check that a server can listen there: viser itself would silently take another port.

    Raises:
        ConfigError: If the port is in use or reserved, or the host is no address of this machine.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = found[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ConfigError(f"cannot serve at {host}:{port}: {reason}; choose another --port or --host") from error


@contextmanager
def viewer_server(host: str, port: int, title: str) -> Iterator[Any]:
    """Serve a viser page; the server is stopped at the end.

    Args:
        host: Address to listen at; 127.0.0.1 is reachable from this machine only.
        port: TCP port.
        title: Name of the page.

    Yields:
        The ``viser.ViserServer``.

    Raises:
        ConfigError: See :func:`check_address`.
        MissingDependencyError: If viser is not installed.
    """
    viser = import_viser()
    check_address(host, port)
    # viser announces itself and its end on standard output, which is for results.
    with contextlib.redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
