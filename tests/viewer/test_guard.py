"""The viewer's door: who is let in, where it listens, what it refuses."""

import socket

import pytest
from websockets.datastructures import Headers

from openvocab_occ.errors import ConfigError
from openvocab_occ.viewer.guard import Door, is_loopback, listen

TOKEN = "0123456789abcdef"


def refusal(found: Headers, path: str = "/") -> str | None:
    return Door().refusal(found, path)


def headers(*pairs: tuple[str, str]) -> Headers:
    return Headers(pairs)


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:8080", "[::1]:8080", "LOCALHOST:9000", "127.0.0.1"])
def test_own_page_and_programs_without_origin_are_let_in(host):
    assert refusal(headers(("Host", host))) is None
    assert refusal(headers(("Host", host), ("Origin", f"http://{host}"))) is None


@pytest.mark.parametrize(
    "pairs",
    [
        [],
        [("Host", "evil.example")],
        [("Host", "127.0.0.1.evil.example:8080")],
        [("Host", "evil.example@127.0.0.1")],
        [("Host", "192.168.0.7:8080")],
        [("Host", "127.0.0.1:8080"), ("Host", "evil.example")],
        [("Host", "127.0.0.1:8080"), ("Origin", "https://evil.example")],
        [("Host", "127.0.0.1:8080"), ("Origin", "http://127.0.0.1:9999")],
        [("Host", "127.0.0.1:8080"), ("Origin", "null")],
        [("Host", "127.0.0.1:8080"), ("Origin", "http://127.0.0.1:8080"), ("Origin", "https://evil.example")],
        [("Host", "[127.0.0.1"), ("Origin", "http://[")],
    ],
)
def test_everyone_else_is_refused(pairs):
    assert refusal(headers(*pairs)) is not None


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "example.com", ""])
def test_a_host_that_is_not_this_machine_is_refused_with_a_way_out(host):
    assert not is_loopback(host)
    with pytest.raises(ConfigError, match=r"serves this machine only.*ssh -L 8080:127\.0\.0\.1:8080"):
        listen(host, 8080, Door())


def test_a_taken_port_is_named_and_no_other_is_taken():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(ConfigError, match=f"port {port} is taken"):
            listen("127.0.0.1", port, Door())


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_out_of_range_is_refused(port):
    with pytest.raises(ConfigError, match="0 to 65535"):
        listen("127.0.0.1", port, Door())


def test_port_zero_takes_a_free_one_and_gives_it_back():
    with listen("localhost", 0, Door()) as bound:
        port = bound.getsockname()[1]
        assert port > 0
    listen("127.0.0.1", port, Door()).close()


@pytest.mark.parametrize("host", ["car.example:8080", "192.168.0.7:8080", "127.0.0.1:8080"])
def test_with_a_token_any_address_serves_whoever_has_it(host):
    door = Door(TOKEN)
    assert "needs the token" in str(door.refusal(headers(("Host", host))))
    assert "needs the token" in str(door.refusal(headers(("Host", host)), f"/?token={TOKEN[:-1]}x"))
    assert door.refusal(headers(("Host", host)), f"/?token={TOKEN}") is None
    kept = door.cookie.partition(";")[0]
    assert door.refusal(headers(("Host", host), ("Cookie", f"a=b; {kept}"), ("Origin", f"http://{host}"))) is None
    assert door.refusal(headers(("Host", host), ("Cookie", kept), ("Origin", "https://evil.example"))) is not None
    assert door.refusal(headers(("Host", host), ("Cookie", kept[:-1]))) is not None


def test_the_cookie_is_not_for_scripts_nor_other_sites():
    assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in Door(TOKEN).cookie.split(";")}


def test_without_a_token_none_is_accepted():
    assert not Door().invites("/?token=None")
    assert not Door().invites("/?token=")


@pytest.mark.parametrize("token", ["", "short", "0123456789abcde;", "0123456789abcdef\n", "x" * 300])
def test_weak_and_unsendable_tokens_are_refused(token):
    with pytest.raises(ConfigError, match="token is not usable"):
        Door(token)
