"""A model's reading of a bundle is judged: a stub that reads the words is right, one that sees nothing is not."""

import dataclasses
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from openvocab_occ.cli import main
from openvocab_occ.errors import ConfigError, DataError
from openvocab_occ.evaluation.vlm import KINDS, Shown, judge, questions_of, read_answer, summarize
from openvocab_occ.export import export_views
from openvocab_occ.objects import ObjectTree
from openvocab_occ.query.llm import LanguageModel


@pytest.fixture(scope="module")
def bundle(street, tmp_path_factory):
    states = {"truck": "parked", "car": "moving", "person": "stopped"}
    nodes = [dataclasses.replace(n, state=states.get(n.label, n.state)) for n in street.objects.nodes]
    scene = dataclasses.replace(street, objects=ObjectTree(nodes))
    return export_views(scene, tmp_path_factory.mktemp("vlm") / "bundle")


def read_table(text):
    """The table of a prompt, as a careful reader would take it: mark -> label, state, ahead, range, bearing."""
    rows = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and cells[0].isdigit():
            rows[int(cells[0])] = (cells[1], cells[2].split()[0], float(cells[3]), float(cells[5]), float(cells[6]))
    return rows


def reader(text, question):
    """Answer from the words alone; a guess where there is no table."""
    rows = read_table(text)
    label = (re.findall('"([^"]*)"', question) or [None])[0]
    marks = [int(mark) for mark in re.findall(r"mark (\d+)", question)]
    if not rows:
        return "unknown"
    if question.startswith("How many"):
        return sum(row[1] == "parked" if label is None else row[0] == label for row in rows.values())
    if question.startswith("Is any"):
        return "yes" if any(row[0] == label for row in rows.values()) else "no"
    if "left or to the right" in question:
        return "left" if rows[marks[0]][4] > 0 else "right"
    if "nearest" in question:
        return min((row[3], mark) for mark, row in rows.items() if row[0] == label)[1]
    if "farther ahead" in question:
        return f"mark {max(marks, key=lambda mark: rows[mark][2])}"
    return rows[marks[0]][1]


@pytest.fixture
def service():
    """An OpenAI-compatible stub; `say(text, question)` makes the content of its replies."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            parts = body["messages"][1]["content"]
            words = [part["text"] for part in parts if part["type"] == "text"]
            seen.append([part["type"] for part in parts])
            question = re.search(r"Question: (.*)", "\n".join(words))[1]
            said = state["say"]("\n".join(words), question)
            status = 200 if isinstance(said, str) else said
            self.send_response(status)
            self.end_headers()
            if status == 200:
                self.wfile.write(json.dumps({"choices": [{"message": {"content": said}}]}).encode())

        def log_message(self, *_):
            pass

    seen, state = [], {"say": lambda text, question: json.dumps({"answer": reader(text, question)})}
    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/v1", state, seen
    server.shutdown()
    thread.join()
    server.server_close()


def test_the_words_of_a_bundle_answer_its_questions(bundle, service):
    """A reader of prompt.md alone gets everything right; without the table, or blind, it gets nothing."""
    url, _, seen = service
    model = LanguageModel(url=url, model="stub")
    questions = questions_of(bundle)
    read = summarize(judge(bundle, model, shown=Shown()), questions)
    assert set(read) == {*KINDS, "all"} - {"on_road"}  # of views along a route
    assert {kind: score.correct for kind, score in read.items()} == dict.fromkeys(read, 1.0)
    assert seen[0].count("image_url") == 2
    blind = summarize(judge(bundle, model), questions)["all"]
    assert (blind.correct, blind.unread) == (0.0, 1.0)
    assert "image_url" not in seen[-1]
    bare = summarize(judge(bundle, model, shown=Shown(table=False)), questions)["all"]
    assert bare.correct == 0.0
    assert 0.2 < blind.chance < 0.6


def test_guessing_is_about_as_good_as_chance(bundle, service):
    url, state, _ = service
    state["say"] = lambda text, question: json.dumps({"answer": {"Is": "yes"}.get(question.split()[0], 1)})
    questions = questions_of(bundle)
    scores = summarize(judge(bundle, LanguageModel(url=url, model="stub")), questions)
    assert scores["exists"].correct == 0.5 == scores["exists"].chance


@pytest.mark.parametrize(("reply", "expected"), [
    ('{"answer": 3}', 3), ('```json\n{"answer": "mark 3"}\n```', 3), ('{"answer": 3.0}', 3),
    ('{"answer": "3 or 4"}', None),
    ("three", None), ('{"answer": true}', None), ("[]", None), ('{"answer": null}', None), ('{"answer": 2.5}', None),
])  # fmt: skip
def test_numbers_are_read(reply, expected):
    assert read_answer(reply, {"answer": 3}) == expected


@pytest.mark.parametrize(("reply", "expected"), [
    ('{"answer": "Yes."}', "yes"), ('{"answer": false}', "no"), ('{"answer": "yes or no"}', None), ("", None),
    ('{"answer": ["yes"]}', None), ('{"answer": "unknown"}', None),
])  # fmt: skip
def test_choices_are_read(reply, expected):
    assert read_answer(reply, {"answer": "yes", "choices": ["yes", "no"]}) == expected


def test_a_service_that_is_not_there_or_refuses(bundle, service):
    url, state, _ = service
    state["say"] = lambda text, question: 401
    with pytest.raises(ConfigError, match="the model refuses: got HTTP 401"):
        judge(bundle, LanguageModel(url=url, model="stub"))
    with pytest.raises(ConfigError, match="the model cannot be reached"):
        judge(bundle, LanguageModel(url="http://127.0.0.1:9/v1", model="stub", timeout=2.0))


def test_broken_questions_are_told(bundle, tmp_path):
    (tmp_path / "view.json").write_text((bundle.folder / "view.json").read_text())
    (tmp_path / "questions.json").write_text('{"questions": [{"kind": "riddle"}]}')
    with pytest.raises(DataError, match=r"questions\.json cannot be read"):
        questions_of(dataclasses.replace(bundle, folder=tmp_path))


def test_the_command(bundle, service, capsys):
    url, _, _ = service
    assert main(["eval", "vlm", str(bundle.folder), "--endpoint", url, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["scores"]["all"]["all"]["correct"] == 1.0
    assert report["scores"]["blind"]["all"]["correct"] == 0.0
    assert report["synthetic"] is True
    assert main(["eval", "vlm", str(bundle.folder), "--endpoint", url, "--leave-out", "table", "--no-blind"]) == 0
    assert "without table" in capsys.readouterr().out
    assert main(["eval", "vlm", str(bundle.folder.parent), "--endpoint", url]) == 2
    assert "is not a view bundle" in capsys.readouterr().err
