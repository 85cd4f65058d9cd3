"""Who may talk to the viewer: this machine, through pages the viewer itself served, and who has the token.

viser binds to every interface, takes the next port when one is busy, answers any web page that knows the port, and
opens a public tunnel when a client asks. All four are closed here.
"""

import contextlib
import errno
import http
import ipaddress
import re
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from hmac import compare_digest
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable
from urllib.parse import parse_qs, urlsplit

from openvocab_occ.errors import ConfigError

if TYPE_CHECKING:
    import viser

_TOKEN_LENGTH = 16
_COOKIE = "openvocab_occ_token"
_building = threading.Lock()  # construction swaps a name of the websockets module


@runtime_checkable
class Headers(Protocol):
    """The headers of an HTTP request."""

    def get_all(self, key: str) -> list[str]:
        """Return every value of a header."""
        ...


def is_loopback(host: str) -> bool:
    """Tell whether a host name means this machine, without asking a name server."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass(frozen=True)
class Door:
    """Who is let in: without a token this machine only, with one whoever shows it, from any address."""

    token: str | None = None

    def __post_init__(self) -> None:
        if self.token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{_TOKEN_LENGTH},200}}", self.token):
            raise ConfigError(
                "token is not usable", expected=f"{_TOKEN_LENGTH} or more letters, digits, - and _",
                got=f"{len(self.token)} letters", fix="python -c 'import secrets; print(secrets.token_urlsafe())'",
            )  # fmt: skip

    def refusal(self, headers: Headers, path: str = "/") -> str | None:
        """Return why a request must be answered 403, or None.

        Without a token the Host must name this machine, which stops pages that rebind their own name to 127.0.0.1; a
        port is not compared, since an SSH tunnel may use another. With one, the address or the cookie must hold it. The
        Origin, which browsers always send with a websocket, must be that same host, which stops every other page. A
        program that is no browser sends none and may connect.
        """
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        try:
            name = urlsplit(f"//{hosts[0]}").hostname if len(hosts) == 1 and "@" not in hosts[0] else None
            if name is None or (self.token is None and not is_loopback(name)):
                return "this viewer answers only to its own machine"
            if len(origins) > 1 or (origins and urlsplit(origins[0]).netloc != hosts[0]):
                return "this viewer answers only to its own page"
        except ValueError:  # brackets that enclose no address
            return "host or origin cannot be read"
        if self.token is not None and not (self.invites(path) or self._knows(headers.get_all("Cookie"))):
            return "this viewer needs the token: open the address that it printed"
        return None

    def invites(self, path: str) -> bool:
        """Tell whether an address holds the token."""
        try:
            given = parse_qs(urlsplit(path).query).get("token", [])
        except ValueError:
            return False
        return self.token is not None and any(compare_digest(one.encode(), self.token.encode()) for one in given)

    @property
    def cookie(self) -> str:
        """What a browser is told to keep; scripts cannot read it, and other sites' requests do not carry it."""
        return f"{_COOKIE}={self.token}; Path=/; HttpOnly; SameSite=Strict"

    def _knows(self, cookies: list[str]) -> bool:
        pairs = [pair.strip().partition("=") for line in cookies for pair in line.split(";")]
        held = [value for name, _, value in pairs if name == _COOKIE]
        return self.token is not None and any(compare_digest(one.encode(), self.token.encode()) for one in held)


def listen(host: str, port: int, door: Door) -> socket.socket:
    """Bind a TCP socket on this machine, or where a token guards it on any address; port 0 takes any free one.

    Raises:
        ConfigError: The host is not this machine, or the port is taken or not allowed.
    """
    if door.token is None and not is_loopback(host):
        raise ConfigError(
            "without a token the viewer serves this machine only",
            expected="127.0.0.1, localhost or ::1",
            got=host,
            fix="pass a token, or to look from another machine, open a tunnel there: "
            f"ssh -L {port}:127.0.0.1:{port} user@this-machine",
        )
    if not 0 <= port <= 65535:
        raise ConfigError("port is out of range", expected="0 to 65535", got=port)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    bound = socket.socket(family, socket.SOCK_STREAM)
    try:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # a port just left is free; one in use is not
        bound.bind(("127.0.0.1" if host.lower() == "localhost" else host, port))
        bound.listen()
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            raise ConfigError(f"port {port} is taken", fix="stop the other program or pass another --port") from error
        raise ConfigError(f"port {port} cannot be opened on {host}", got=error.strerror) from error
    return bound


def guarded_server(host: str, port: int, label: str, door: Door | None = None) -> "viser.ViserServer":
    """Start a viser server behind a door, on exactly this port, that cannot be shared through a tunnel."""
    import viser
    import viser._messages
    import websockets.asyncio.server as websockets

    door = door or Door()
    bound = listen(host, port, door)
    original = websockets.serve

    def serve(handler: Any, _host: str, _port: int, *, process_request: Any, **options: Any) -> Any:
        def checked(connection: Any, request: Any) -> Any:
            reason = door.refusal(request.headers, request.path)
            if reason is not None:
                return connection.respond(http.HTTPStatus.FORBIDDEN, reason + "\n")
            if door.invites(request.path) and "Upgrade" not in request.headers:  # the token goes from address to cookie
                answer = connection.respond(http.HTTPStatus.FOUND, "")
                answer.headers["Location"], answer.headers["Set-Cookie"] = "/", door.cookie
                return answer
            return process_request(connection, request)

        return original(handler, sock=bound, process_request=checked, **options)

    with _building, _quiet_console():
        websockets.serve = serve  # viser offers no hook of its own; its thread looks the name up while it starts
        try:
            server = viser.ViserServer(host=host, port=bound.getsockname()[1], label=label, verbose=False)
        except BaseException:
            bound.close()
            raise
        finally:
            websockets.serve = original
    server._websock_server.unregister_handler(viser._messages.ShareUrlRequest)
    return server


def stop(server: "viser.ViserServer") -> None:
    """Stop a server without the line viser prints."""
    with _quiet_console():
        server.stop()


@contextlib.contextmanager
def _quiet_console() -> Iterator[None]:
    """Keep viser's banner off stdout, which belongs to the caller."""
    import rich

    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
