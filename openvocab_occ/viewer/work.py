"""Work off the callback threads: one lane of it at a time, and of what waits only the latest."""

import logging
import threading
import time
from collections.abc import Callable

_log = logging.getLogger(__name__)

IsCurrent = Callable[[], bool]
"""False as soon as newer work has come: what was computed is then of no use."""
Job = Callable[[IsCurrent], None]


class Lane:
    """A thread that does the latest job it was given; those that waited meanwhile are dropped.

    viser runs callbacks on many threads at once and in no order; they only put work here.
    """

    def __init__(
        self, failed: Callable[[Exception], None], busy: Callable[[bool], None] | None = None, *, rest: float = 0.0
    ) -> None:
        """Begin idle.

        Args:
            failed: Told of what a job raises; the lane goes on.
            busy: Told when work begins and when none is left.
            rest: Seconds from the beginning of one job to that of the next, at least.
        """
        self._failed, self._busy, self._rest = failed, busy, rest
        self._wake = threading.Condition()
        self._waiting: Job | None = None
        self._ticket = 0
        self._working = False
        self._closed = False
        self._thread: threading.Thread | None = None

    def put(self, job: Job) -> None:
        """Do this next, and nothing that waits; returns at once."""
        with self._wake:
            if self._closed:
                return
            self._ticket += 1
            self._waiting = job
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()
            self._wake.notify_all()

    def idle(self) -> bool:
        """Tell whether nothing is done or waits."""
        with self._wake:
            return self._waiting is None and not self._working

    def close(self) -> None:
        """Take no more work; what runs ends by itself and is told that it is not current."""
        with self._wake:
            self._closed, self._waiting = True, None
            self._ticket += 1
            self._wake.notify_all()

    def _run(self) -> None:
        while True:
            with self._wake:
                while self._waiting is None and not self._closed:
                    self._wake.wait()
                if self._closed:
                    return
                job, ticket = self._waiting, self._ticket
                self._waiting, self._working = None, True
            assert job is not None, "only a job wakes an open lane"
            start = time.monotonic()
            self._do(job, ticket)
            with self._wake:
                self._working = False
                left = self._rest - (time.monotonic() - start)
                if left > 0 and not self._closed:
                    self._wake.wait_for(lambda: self._closed, timeout=left)

    def _do(self, job: Job, ticket: int) -> None:
        try:
            if self._busy is not None:
                self._busy(True)
            job(lambda: ticket == self._ticket)
        except Exception as error:  # a viewer outlives any job; who asked is told, the log has the rest
            _log.debug("a job of the viewer failed", exc_info=True)
            if ticket == self._ticket:
                self._failed(error)
        finally:
            if self._busy is not None and ticket == self._ticket:
                self._busy(False)
