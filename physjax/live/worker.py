"""Answers a page in a thread of its own, always the newest request: what it overtakes is dropped, also in the middle."""

import threading
import time
from collections.abc import Callable
from typing import Any

from physjax.live.engine import Answer, Engine
from physjax.live.runs import Overtaken

QUIET_SECONDS = 0.25
"""The stable step is computed when nothing has been asked for this long: it takes too long to be computed in between."""
STRIP_PAUSE_SECONDS, OLDEST_STRIP_SECONDS = 0.03, 0.3
"""Figures are computed when nothing has been asked for the first of these times, or when the last ones are as old as the second:
the next picture comes first."""

Reply = Callable[[dict[str, Any]], None]
"""Takes a message to the page; arrays in it are still arrays."""


class Request:
    """What a page asks for, and how it is answered; each answer bears the number of the request."""

    def __init__(self, asked: dict[str, Any], reply: Reply):
        self.asked, self._reply = asked, reply
        self.done = False

    def reply(self, kind: str, **content: Any) -> None:
        """Send a message, unless the request is done with; "done" and "dropped" are the last of it."""
        if not self.done:
            self.done = kind in ("done", "dropped")
            self._reply({"kind": kind, "ticket": self.asked.get("ticket"), **content})


class Worker:
    """Two threads: one runs what is asked for, one computes stable steps when there is time."""

    def __init__(self, engine: Engine):
        self._engine = engine
        self._changed = threading.Condition()
        self._waiting: Request | None = None
        self._newest: Request | None = None
        self._answered: tuple[Request, Answer] | None = None
        self._closed = False
        self._strip_at = 0.0
        for work in (self._run_newest, self._find_limits):
            threading.Thread(target=work, daemon=True, name=f"physjax explore {work.__name__}").start()

    def submit(self, asked: dict[str, Any], reply: Reply) -> None:
        """Ask for something; what was asked for before and is not answered yet is dropped."""
        request = Request(asked, reply)
        if "code" in asked:  # does not overtake anything
            self._answer_code(request)
            return
        with self._changed:
            before, self._newest = self._newest, request
            self._waiting, self._answered = request, None
            self._changed.notify_all()
        if before is not None:
            before.reply("dropped")

    def close(self) -> None:
        """End both threads as soon as they are done with what they do."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def _answer_code(self, request: Request) -> None:
        try:
            request.reply("code", text=self._engine.write_code(self._engine.read_settings(request.asked)))
        except Exception as error:  # whatever `build` raises is for who wrote it
            request.reply("error", text=describe_exception(error))
        request.reply("done")

    def _run_newest(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is not None or self._closed)
                if self._closed:
                    return
                request, self._waiting = self._waiting, None
            assert request is not None
            try:
                self._answer(request)
            except Overtaken:
                request.reply("dropped")
            except Exception as error:  # a number that `build` refuses: the page says so, and the next one may do
                request.reply("error", text=describe_exception(error))
                request.reply("done")

    def _answer(self, request: Request) -> None:
        engine, overtaken = self._engine, lambda: self._newest is not request
        settings = engine.read_settings(request.asked)
        if engine.will_compile(settings):
            request.reply("busy", text=f"compiling {settings.method}")
        answer = engine.answer(settings, request.asked.get("ghost_box"), overtaken)
        if "figures" not in request.asked:
            request.reply("film", film=answer.film)
        with self._changed:
            if time.monotonic() - self._strip_at < OLDEST_STRIP_SECONDS:
                self._changed.wait_for(overtaken, STRIP_PAUSE_SECONDS)
        if overtaken():
            raise Overtaken
        request.reply("strip", figures=[figure._asdict() for figure in engine.measure(answer, overtaken)])
        self._strip_at = time.monotonic()
        if engine.knows_limit(answer):
            request.reply("done")
            return
        with self._changed:
            if not overtaken():
                self._answered = request, answer
                self._changed.notify_all()

    def _find_limits(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._answered is not None or self._closed)
                if self._closed:
                    return
                asked = self._answered
                if self._changed.wait_for(lambda asked=asked: self._answered is not asked, QUIET_SECONDS):
                    continue
                self._answered = None
            assert asked is not None
            request, answer = asked
            try:
                self._engine.find_limit(answer)
                figures = self._engine.measure(answer, lambda request=request: self._newest is not request)
                request.reply("strip", figures=[figure._asdict() for figure in figures])
            except Overtaken:
                request.reply("dropped")
            except Exception as error:  # the film is there all the same
                request.reply("error", text=describe_exception(error))
            request.reply("done")


def describe_exception(error: Exception) -> str:
    """What went wrong in one line: our sentences as they are, others with the kind of error."""
    text = str(error).strip().partition("\n")[0]
    return text if isinstance(error, ValueError) and text else f"{type(error).__name__}: {text}"


__all__ = ["Request", "Worker", "describe_exception"]
