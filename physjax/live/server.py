"""A live view on a web server of this machine, for a browser without a notebook: the standard library's."""

import json
import queue
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from physjax.live.messages import pack_message
from physjax.live.worker import Worker

HOST = "127.0.0.1"
"""Nothing but this machine can reach it."""
MAX_REQUEST_BYTES = 100_000
"""A request holds a few numbers."""
REPLY_SECONDS = 600.0
"""A request without a reply for so long is given up: nothing compiles for ten minutes."""


class LiveServer(ThreadingHTTPServer):
    """Serves one page, and answers what it asks for by a stream of messages.

    Requests that name another host are refused, so that no page of the web can ask in the name of this one.
    """

    daemon_threads = True

    def __init__(self, page: str, worker: Worker, port: int = 0):
        super().__init__((HOST, port), _Handler)
        self.page, self.worker = page.encode(), worker

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/"


class _Handler(BaseHTTPRequestHandler):
    disable_nagle_algorithm = True  # a film is not held back until the page has confirmed what came before it
    server: LiveServer  # pyright: ignore[reportIncompatibleVariableOverride]  it serves this one alone

    def do_GET(self) -> None:
        """The page."""
        if not self._is_for_us() or self.path != "/":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(self.server.page)))
        self.end_headers()
        self.wfile.write(self.server.page)

    def do_POST(self) -> None:
        """Messages until one says that it is the last."""
        length = int(self.headers.get("Content-Length", 0))
        if not self._is_for_us() or self.path != "/ask" or length > MAX_REQUEST_BYTES:
            self.send_error(404)
            return
        try:
            asked = json.loads(self.rfile.read(length))
        except ValueError:
            self.send_error(400)
            return
        self.send_response(200)
        self.send_header("Content-Type", "application/octet-stream")
        self.end_headers()
        replies: queue.Queue[dict[str, Any]] = queue.Queue()
        self.server.worker.submit(asked, replies.put)
        self._stream(lambda: replies.get(timeout=REPLY_SECONDS))

    def _stream(self, get: Callable[[], dict[str, Any]]) -> None:
        try:
            while (message := get())["kind"] not in ("done", "dropped"):
                self.wfile.write(pack_message(message))
            self.wfile.write(pack_message(message))
        except (BrokenPipeError, ConnectionResetError, queue.Empty):
            self.close_connection = True

    def _is_for_us(self) -> bool:
        own = {f"{host}:{self.server.server_port}" for host in (HOST, "localhost")}
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in own and (origin is None or origin.removeprefix("http://") in own)

    def log_message(self, format: str, *arguments: object) -> None:
        """Nothing is logged."""


__all__ = ["LiveServer"]
