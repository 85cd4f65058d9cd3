import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest

from openvocab_occ.errors import ConfigError, QueryError
from openvocab_occ.query import algebra as q
from openvocab_occ.query.grammar import parse
from openvocab_occ.query.llm import LanguageModel

QUERY = q.And((q.Noun("truck"), q.State("parked")))


@pytest.fixture
def service():
    """A stub of a chat service that replies what it is told to, and keeps what it was sent."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            seen.append(
                (self.path, dict(self.headers), json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            )
            status, body = reply["is"]
            self.send_response(status)
            self.send_header("Location", "http://127.0.0.1:1/elsewhere")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_):
            pass

    seen, reply = [], {"is": (200, b"")}
    server = HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    model = LanguageModel(url=f"http://127.0.0.1:{server.server_port}/v1/", model="stub", key="secret", timeout=5.0)

    def says(content, status=200):
        body = content if isinstance(content, bytes) else json.dumps({"choices": [{"message": {"content": content}}]})
        reply["is"] = (status, body if isinstance(body, bytes) else body.encode())

    yield model, says, seen
    server.shutdown()
    thread.join()
    server.server_close()


def test_a_valid_reply_is_the_query(service):
    model, says, seen = service
    for text in (q.to_json(QUERY), f"```json\n{q.to_json(QUERY)}\n```"):
        says(text)
        found = model.parse("the lorries that nobody has moved in a while", ["truck"])
        assert (found.query, found.unread) == (QUERY, ())
        assert found.notes == ("read by language model stub",)
    path, headers, body = seen[0]
    assert path == "/v1/chat/completions"
    assert headers["Authorization"] == "Bearer secret"
    assert body["messages"][1] == {"role": "user", "content": "the lorries that nobody has moved in a while"}
    assert "discriminator" in body["messages"][0]["content"]
    assert "secret" not in repr(model)


@pytest.mark.parametrize(
    ("content", "status"),
    [
        ("I think you want trucks.", 200),
        ('{"op":"eval"}', 200),
        ('{"op":"not","of":' * 5000, 200),
        (q.to_json(q.Vector((1.0,))), 200),
        (q.to_json(q.Me()), 200),
        (b"not json", 200),
        (b'{"choices":[]}', 200),
        (b'{"choices":[{"message":{"content":7}}]}', 200),
        (b"[" * 100_000, 200),
        (b" " * ((1 << 20) + 1), 200),
        (q.to_json(QUERY), 500),
        (q.to_json(QUERY), 302),
    ],
)
def test_anything_else_falls_back_to_the_grammar(service, content, status):
    model, says, _ = service
    says(content, status)
    found = model.parse("red car next to the bus")
    assert found.query == parse("red car next to the bus").query
    assert "read by the grammar" in found.notes[-1]


def test_no_service_falls_back_too():
    model = LanguageModel(url="http://127.0.0.1:1", model="none", timeout=1.0)
    assert model.parse("car").query == q.Noun("car")
    with pytest.raises(QueryError, match="query is empty"):
        model.parse("  ")
    with pytest.raises(ConfigError, match="address of the language model"):
        LanguageModel(url="file:///etc/passwd", model="none")
