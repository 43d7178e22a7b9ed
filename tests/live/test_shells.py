"""Around the engine: the worker drops what is overtaken, messages arrive whole, and pages hold what they must and no more."""

import base64
import http.client
import json
import re
import struct
import sys
import threading

import jax.numpy as jnp
import numpy as np
import pytest

from physjax import Particles, Scene, explore, forces, methods
from physjax.live.messages import pack_message, split_message
from physjax.live.worker import Worker


def throw(speed):
    return Scene(Particles(jnp.zeros(2), speed * jnp.array([0.6, 0.8])), forces=(forces.Gravity(),))


@pytest.fixture(scope="module")
def explorer():
    return explore(throw, speed=(10, 50), duration=3.0, methods=[methods.verlet], title="<script>alert(1)</script>")


class Page:
    """What a page is told, and when it is told the last of it."""

    def __init__(self):
        self.messages, self.ended = [], threading.Event()

    def __call__(self, message):
        self.messages.append(message)
        if message["kind"] in ("done", "dropped"):
            self.ended.set()

    def kinds(self):
        assert self.ended.wait(60)
        return [message["kind"] for message in self.messages]


def test_a_request_is_answered_by_a_film_and_then_by_figures(explorer):
    page = Page()
    explorer._worker.submit({"ticket": 3, "numbers": {"speed": 20.0}}, page)
    assert page.kinds() in (["film", "strip", "done"], ["film", "strip", "strip", "done"])
    assert {message["ticket"] for message in page.messages} == {3}
    assert page.messages[0]["film"]["part"]["places"].dtype == np.int16
    assert "…" not in [figure["value"] for figure in page.messages[-2]["figures"]]


class SlowEngine:
    """An engine whose answers take until they are overtaken, but the last."""

    def __init__(self):
        self.running, self.answered = threading.Semaphore(0), []

    def read_settings(self, asked):
        return asked["ticket"]

    def will_compile(self, settings):
        return False

    def knows_limit(self, answer):
        return True

    def measure(self, answer, overtaken):
        return []

    def answer(self, settings, ghost_box, overtaken):
        from physjax.live.runs import Overtaken

        self.running.release()
        while settings < 9:
            if overtaken():
                raise Overtaken
        self.answered.append(settings)
        return type("Answer", (), {"film": {}})


def test_what_is_overtaken_is_dropped_while_it_runs_and_while_it_waits():
    engine = SlowEngine()
    worker, pages = Worker(engine), [Page() for _ in range(3)]
    worker.submit({"ticket": 1}, pages[0])
    engine.running.acquire()
    for ticket, page in ((2, pages[1]), (9, pages[2])):
        worker.submit({"ticket": ticket}, page)
    assert pages[0].kinds() == pages[1].kinds() == ["dropped"]
    assert pages[2].kinds() == ["film", "strip", "done"]
    assert engine.answered == [9]
    worker.close()


def test_what_a_build_refuses_is_told_and_the_next_setting_works(explorer):
    def build(speed):
        if speed > 40:
            raise ValueError("speed: got more than 40 m/s.")
        return throw(speed)

    broken, page, again = explore(build, speed=(10, 50), duration=3.0, methods=[methods.verlet]), Page(), Page()
    broken._worker.submit({"ticket": 1, "numbers": {"speed": 45.0}}, page)
    assert page.kinds() == ["error", "done"]
    assert page.messages[0]["text"] == "speed: got more than 40 m/s."
    broken._worker.submit({"ticket": 2, "numbers": {"speed": 30.0}, "figures": True}, again)
    assert again.kinds()[0] == "strip"


def test_a_button_has_the_code_of_the_present_setting(explorer):
    page = Page()
    explorer._worker.submit({"ticket": 1, "numbers": {"speed": 21.0}, "code": True}, page)
    assert page.kinds() == ["code", "done"]
    assert "throw(speed=21.0)" in page.messages[0]["text"]


def unpack(data):
    """As the page does it."""
    whole, length = struct.unpack("<II", data[:8])
    assert whole == len(data)
    header = json.loads(data[8 : 8 + length])
    buffers = [data[8 + length + start :][:size] for start, size in header["spans"]]
    return header["message"], buffers


def test_arrays_travel_as_bytes_behind_the_text():
    arrays = [np.arange(5, dtype=np.int16), np.array([[1.5, 2.5]])]
    message = {"kind": "film", "parts": [{"places": arrays[0]}, {"other": arrays[1], "name": "é"}]}
    found, buffers = unpack(pack_message(message))
    assert found == split_message(message)[0]
    for part, array in zip((found["parts"][0]["places"], found["parts"][1]["other"]), arrays, strict=True):
        np.testing.assert_array_equal(np.frombuffer(buffers[part["array"]], part["kind"]), array.ravel())


def test_the_server_answers_this_machine_alone(explorer):
    with explorer.start_server() as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()

        def ask(method, path, body=None, **headers):
            connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=60)
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            return answer.status, answer.read()

        status, page = ask("GET", "/")
        assert (status, page.decode()) == (200, server.page.decode())
        status, data = ask("POST", "/ask", json.dumps({"ticket": 1, "numbers": {"speed": 30.0}}))
        first = struct.unpack("<I", data[:4])[0]
        assert status == 200
        assert unpack(data[:first])[0]["kind"] == "film"
        assert ask("GET", "/", Host="evil.example")[0] == 404
        assert ask("POST", "/ask", "{}", Origin="http://evil.example")[0] == 404
        assert ask("GET", "/etc/passwd")[0] == 404
        assert ask("POST", "/ask", "{")[0] == 400
        server.shutdown()


def test_the_page_fetches_nothing_and_a_title_stays_text(explorer, tmp_path):
    page = explorer.save(tmp_path / "live.html").read_text(encoding="utf-8")
    assert "<script>alert(1)" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert not re.search(r"__[A-Z]+__|<link [^>]*href=\"(?!data:,)|src=|import\(", page)
    spec = json.loads(re.search(r'id="spec">(.*?)</script>', page, re.S)[1])
    assert spec["title"] == "<script>alert(1)</script>"
    assert spec["page"].startswith("<!doctype html>")
    assert "throw(speed=30.0)" in spec["code"]


def test_a_widget_hands_requests_on_and_messages_back(explorer):
    pytest.importorskip("anywidget")
    widget, sent, ended = explorer.widget, [], threading.Event()

    def send(content, buffers=None):
        sent.append((content, buffers))
        if content["kind"] == "done":
            ended.set()

    widget.send = send
    widget._handle_custom_msg({"ticket": 5, "numbers": {"speed": 15.0}}, [])
    assert ended.wait(60)
    film, buffers = sent[0]
    assert film["kind"] == "film"
    assert len(buffers[film["film"]["part"]["places"]["array"]]) == 97 * 2 * 2
    bundle, _ = explorer._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in bundle
    assert len(base64.b64decode(bundle["image/png"])) > 4000, "what is seen of a saved notebook"


def test_without_the_libraries_a_notebook_gets_a_sentence_and_the_page(monkeypatch):
    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "physjax.live.widget", raising=False)
    alone = explore(throw, speed=(10, 50), duration=1.0, methods=[methods.verlet], frames=4)
    shown = alone._repr_mimebundle_()
    assert 'pip install "physjax[explore]"' in shown["text/html"]
    assert '<img src="data:image/png' in shown["text/html"]
    assert "<iframe srcdoc=" in shown["text/html"]
    with pytest.raises(ImportError, match="physjax\\[explore\\]"):
        _ = alone.widget


def test_a_notebook_leaves_its_sliders_the_arrow_keys_and_its_strip_the_layout():
    """Both seen in JupyterLab 4: it takes the keys of all that is no text field, and lets the names of lists float."""
    from physjax.live.pages import read_live_file

    assert 'querySelectorAll("input, select, button")) part.dataset.lmSuppressShortcuts' in read_live_file("live.js")
    assert ".physjax-live .strip dt { float: none;" in read_live_file("live.css")
