"""Writes that a drive does not wait for."""

import threading
from collections import deque
from types import TracebackType

import numpy as np
from jaxtyping import Bool, Float

from openvocab_occ.arrays import ArrayLike
from openvocab_occ.errors import ConfigError
from openvocab_occ.geometry import GridSpec
from openvocab_occ.memory.journal import Entry
from openvocab_occ.memory.tile_map import Policy, TileMap, Written


class Writer:
    """Writes of one drive, committed by a thread in the background, several at a time.

    Tiles that follow each other along a street overlap, so that writes that wait are cheaper than writes that do not:
    each tile is committed once for all of them. What the map holds in the end is the same.

        with Writer(city, agent="car-7", log="2026-11-22a") as writer:
            for frame in drive:
                writer.write(logits, mask, frame.T_world_ego, spec, stamp=frame.timestamp)

    Leaving the block waits until all is durable. A failed commit, of a full disk say, is raised by the next call; what
    it was about to write is kept and tried again then.
    """

    def __init__(self, city: TileMap, *, agent: str, log: str, policy: Policy = "newest", most: int = 8) -> None:
        """Begin; `most` writes may wait, the next one has to."""
        if most < 1:
            raise ConfigError("most is not usable", expected="1 or more writes", got=most)
        self._city, self._agent, self._log, self._most = city, agent, log, most
        self._policy: Policy = policy
        self._waiting: deque[Entry] = deque()
        self._error: Exception | None = None
        self._closed = False
        self._written = Written(0, 0, 0)
        self._change = threading.Condition()
        city.admit(agent)
        self._thread = threading.Thread(target=self._work, name="tile writer", daemon=True)
        self._thread.start()

    def write(
        self,
        logits: Float[np.ndarray, "x y z classes"],
        mask: Bool[np.ndarray, "x y z"],
        T_world_ego: ArrayLike,
        spec: GridSpec,
        *,
        stamp: float,
        durable: bool = False,
    ) -> None:
        """Take a write; the arrays may be used again on return. With `durable` it is stored on return, and all before.

        Raises what `TileMap.write` raises: of this write's arguments at once, of earlier commits that failed later.
        """
        entry = self._city.prepare(
            logits, mask, T_world_ego, spec, stamp=stamp, agent=self._agent, log=self._log, policy=self._policy
        )
        with self._change:
            if self._closed:
                raise ConfigError("the writer is closed", fix="make another one")
            self._change.wait_for(lambda: len(self._waiting) < self._most or self._error)
            self._raise()
            self._waiting.append(entry)
            self._change.notify_all()
        if durable:
            self.flush()

    def flush(self) -> Written:
        """Wait until all that was taken is durable; return what was done since the last flush."""
        with self._change:
            self._change.wait_for(lambda: not self._waiting or self._error)
            self._raise()
            done, self._written = self._written, Written(0, 0, 0)
            return done

    def close(self) -> None:
        """Flush, and end the thread. What could not be written is given up."""
        try:
            self.flush()
        finally:
            with self._change:
                self._closed = True
                self._change.notify_all()
            self._thread.join()

    def __enter__(self) -> "Writer":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _raise(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            self._change.notify_all()  # try again
            raise error

    def _work(self) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._closed or (self._waiting and not self._error))
                if self._closed:
                    return
                batch = [*self._waiting]
            try:
                done = self._city.put(batch)
            except Exception as error:  # told to whoever calls next, on their thread
                with self._change:
                    self._error = error
                    self._change.notify_all()
                continue
            with self._change:
                for _ in batch:
                    self._waiting.popleft()
                sums = zip(_numbers(self._written), _numbers(done), strict=True)
                self._written = Written(*(a + b for a, b in sums))
                self._change.notify_all()


def _numbers(done: Written) -> tuple[int, int, int]:
    """Return the numbers of a write."""
    return done.voxels, done.changed, done.tiles
