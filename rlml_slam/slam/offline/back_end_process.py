# SPDX-License-Identifier: Apache-2.0
"""The back end in a process of its own: two threads of Python mostly wait for one another.

The process begins as a copy of this one, compiled kernels included. Frames go there through a
pipe, BATCH at a time, and updates come back through another, one for each frame and in their
order.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, TypeAlias

from rlml_slam.maps.saved_map import SavedMap
from rlml_slam.slam.back_end.back_end import BackEnd, Update
from rlml_slam.slam.offline.frame_batch import Batch, packed, unpacked
from rlml_slam.types import Frame

PIPE = 1 << 20  # bytes of a pipe, some hundred frames, where the system can
BATCH = 32  # frames: by then a message more costs next to nothing per frame
MAP, HOME = 'map', 'home'  # asked instead of frames
Answer: TypeAlias = list[Update | None] | BackEnd | SavedMap


class BackEndProcess:
    """A back end that takes frames and is asked for what they did later."""

    def __init__(self, back_end: BackEnd, add: Callable[[BackEnd, Frame], Update | None]) -> None:
        context = multiprocessing.get_context('fork')
        theirs, self._frames = _pipe(context)
        self._updates, ours = _pipe(context)
        self._waiting: list[Frame] = []  # not sent yet
        self._came: deque[Update | None] = deque()
        self._owed = 0  # answers that did not come yet
        self._process = context.Process(
            target=self._run, args=(back_end, add, theirs, ours), name='back end', daemon=True
        )
        with warnings.catch_warnings():
            # the threads are those of BLAS, which takes care of forks itself
            warnings.simplefilter('ignore', DeprecationWarning)
            self._process.start()
        theirs.close()
        ours.close()

    def add(self, frame: Frame) -> None:
        """Send a frame; its answer is one of those that :meth:`update` gives, in order."""
        self._waiting.append(frame)
        if len(self._waiting) >= BATCH:
            self._send()

    def update(self) -> Update | None:
        """What the oldest frame did for which that was not asked yet."""
        if not self._came:
            if not self._owed:
                self._send()
            self._came += self._receive()
        return self._came.popleft()

    def map(self) -> SavedMap:
        """The map as it is after all frames."""
        answer: SavedMap = self._ask(MAP)
        return answer

    def bring_home(self) -> BackEnd:
        """The back end, after all frames; the process ends."""
        back_end: BackEnd = self._ask(HOME)
        self._process.join()
        return back_end

    def _run(
        self,
        back_end: BackEnd,
        add: Callable[[BackEnd, Frame], Update | None],
        frames: Connection,
        updates: Connection,
    ) -> None:
        # the copies of this side's ends: with them, the process would not see that this one ended
        self._frames.close()
        self._updates.close()
        _serve(back_end, add, frames, updates)

    def _send(self) -> None:
        while self._owed and self._updates.poll():
            self._came += self._receive()
        self._owed += 1
        self._tell(packed(self._waiting))
        self._waiting = []

    def _tell(self, what: Any) -> None:
        try:
            self._frames.send(what)
        except BrokenPipeError:
            self._receive()  # says how the process ended
            raise

    def _ask(self, what: str) -> Any:
        if self._waiting:
            self._send()
        while self._owed:  # what frames did comes before the answer
            self._came += self._receive()
        self._owed += 1
        self._tell(what)
        return self._receive()

    def _receive(self) -> Any:
        try:
            answer = self._updates.recv()
        except EOFError as e:
            self._process.join()
            code = self._process.exitcode
            raise RuntimeError(f"the back end's process ended with exit code {code}") from e
        self._owed -= 1
        if isinstance(answer, BaseException):
            raise answer
        return answer


def _pipe(context: Any) -> tuple[Connection, Connection]:
    """Both ends of a pipe, the receiver's first."""
    receiver, sender = context.Pipe(duplex=False)
    with contextlib.suppress(ImportError, AttributeError, OSError):
        import fcntl

        fcntl.fcntl(sender.fileno(), fcntl.F_SETPIPE_SZ, PIPE)
    return receiver, sender


def _serve(
    back_end: BackEnd,
    add: Callable[[BackEnd, Frame], Update | None],
    frames: Connection,
    updates: Connection,
) -> None:
    """The process: one answer for everything that comes; an error is the last answer."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the other process, and so this one
    inbox: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_read_ahead, args=(frames, inbox), daemon=True).start()
    with contextlib.suppress(BrokenPipeError):
        while data := inbox.get():
            asked = pickle.loads(data)
            answer: Answer | Exception
            try:
                answer = _answer(back_end, add, asked)
            except Exception as e:  # raised again by the other process, whatever it is
                answer = e
            updates.send(answer)
            if asked == HOME or isinstance(answer, Exception):
                return


def _read_ahead(frames: Connection, inbox: SimpleQueue[bytes]) -> None:
    """Take what comes at once, until the end, which is nothing.

    Were the sender to wait, while this process waits for it to take an answer, both would forever.
    """
    with contextlib.suppress(EOFError, OSError):
        while True:
            inbox.put(frames.recv_bytes())
    inbox.put(b'')


def _answer(
    back_end: BackEnd, add: Callable[[BackEnd, Frame], Update | None], asked: Any
) -> Answer:
    if isinstance(asked, Batch):
        return [add(back_end, frame) for frame in unpacked(asked)]
    if asked == MAP:
        return SavedMap(back_end.reflectors(), back_end.occupancy_grid())
    return back_end
