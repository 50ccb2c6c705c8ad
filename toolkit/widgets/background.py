"""Work that would hold up a page: done in a thread, with what follows in the page's own turn."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import panel as pn

from toolkit.errors import ToolkitError

T = TypeVar("T")


class Background:
    """Works for one page, whose document is the one that is current when this is made.

    Parameters
    ----------
    worker:
        Does the work; by default one thread of its own.
    """

    def __init__(self, worker: Executor | None = None) -> None:
        self._worker = worker if worker is not None else ThreadPoolExecutor(1, "background of a page")
        self._document = pn.state.curdoc
        self._round = 0

    def forget(self) -> None:
        """Let what is under way end without a word: nobody wants it any more."""
        self._round += 1

    def start(self, work: Callable[[], T], then: Callable[[T], None], fail: Callable[[str], None]) -> None:
        """Do ``work``, and then in the page's turn ``then`` with its result, or ``fail`` with why there is none.

        Errors that are none of ours are the page's: Panel logs them.
        """
        begun = self._round

        def end(future: Future[T]) -> None:
            if begun != self._round:
                return
            try:
                result = future.result()
            except ToolkitError as error:
                fail(str(error))
            else:
                then(result)

        self._worker.submit(work).add_done_callback(lambda future: self._in_turn(partial(end, future)))

    def _in_turn(self, callback: Callable[[], None]) -> None:
        if self._document is not None and self._document.session_context is not None:
            self._document.add_next_tick_callback(callback)
        else:
            callback()
