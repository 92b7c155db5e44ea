"""The web server of the viewer: its address, and its end."""

from __future__ import annotations

import contextlib
import http
import inspect
import io
import ipaddress
import logging
import socket
from collections.abc import Awaitable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from uni4d_fg.errors import ConfigError, MissingDependencyError
from uni4d_fg.optional import import_viser
from uni4d_fg.results.view.page import answer_with_scripts


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


def is_own_page(host: str, asked: str | None, origin: str | None) -> bool:
    """Tell whether a request comes from the viewer's own page, or from no page at all.

    Args:
        host: Address that the server listens at.
        asked: ``Host`` of the request. On a server for this machine only, it must name this machine: a page could
            otherwise have its own name point here.
        origin: ``Origin`` of the request: the page it comes from; None from programs that are no browsers.
    """
    named = urlsplit(f"//{asked or ''}")
    try:
        name = named.hostname or ""
    except ValueError:
        return False
    if _is_loopback(host) and not _is_loopback(name):
        return False
    return origin is None or (asked is not None and urlsplit(origin).netloc.lower() == asked.lower())


def _is_loopback(name: str) -> bool:
    if name.lower() in ("localhost", "ip6-localhost"):
        return True
    try:
        return ipaddress.ip_address(name.strip("[]")).is_loopback
    except ValueError:
        return False


@contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """Let servers that start within the block refuse requests of other origins, and send the page with our scripts.

    viser has no option for that, but passes what answers requests on to ``websockets``; here a check goes before it.

    Raises:
        MissingDependencyError: If no server started by way of ``websockets``: this version of viser cannot be guarded.
    """
    from websockets.asyncio import server as websockets_server

    serve, guarded = websockets_server.serve, []

    def guarded_serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        guarded.append(True)

        def check(connection: Any, request: Any) -> Any:
            hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
            asked, origin = (found[0] if found else None for found in (hosts, origins))
            if len(hosts) > 1 or len(origins) > 1 or not is_own_page(host, asked, origin):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This page may not use the viewer.\n")
            answer = None if process_request is None else process_request(connection, request)
            if inspect.isawaitable(answer):
                return _later(answer)
            return answer_with_scripts(answer)

        async def _later(answer: Awaitable[Any]) -> Any:
            return answer_with_scripts(await answer)

        return serve(*args, process_request=check, **options)

    setattr(websockets_server, "serve", guarded_serve)  # noqa: B010 - mypy knows that it is a class
    try:
        yield
    finally:
        setattr(websockets_server, "serve", serve)  # noqa: B010
    if not guarded:
        raise MissingDependencyError("this version of viser cannot be guarded: run `pip install 'viser>=1.1,<2'`")


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
    # A connection that is opened and not used, as scans of ports do, is no error of the user's.
    logger = logging.getLogger("websockets.server")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    # viser announces itself and its end on standard output, which is for results.
    with contextlib.redirect_stdout(io.StringIO()), _own_pages_only(host):
        server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
    # Points are not lit. viser's own environment would keep the picture dark until it is decoded and filtered, which
    # takes seconds without a graphics card.
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(cast_shadow=False)
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()
        logger.setLevel(level)
