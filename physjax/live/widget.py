"""The live view in a notebook: a thin shell of anywidget around the engine. Needs the extra `physjax[explore]`."""

from typing import Any

import anywidget
import traitlets

from physjax.live.messages import split_message
from physjax.live.pages import read_live_file, read_style
from physjax.live.worker import Worker


class LiveWidget(anywidget.AnyWidget):
    """Shows the page's program and hands its requests to the worker, and the worker's messages to it."""

    _esm = read_live_file("live.js")
    _css = read_style()
    spec = traitlets.Dict().tag(sync=True)

    def __init__(self, spec: dict[str, Any], worker: Worker):
        super().__init__(spec=spec)
        self._worker = worker
        self.on_msg(lambda _, asked, __: self._worker.submit(asked, self._reply))

    def _reply(self, message: dict[str, Any]) -> None:
        content, buffers = split_message(message)
        self.send(content, buffers)


__all__ = ["LiveWidget"]
