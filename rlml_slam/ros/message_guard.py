# SPDX-License-Identifier: Apache-2.0
"""The one place that every message of a node passes: one that cannot be used costs only itself.

Subscriptions get bytes. Their number is compared with what the topic may have before a message is
made of them: 100 000 poses are in memory in a millisecond, and take rclpy two seconds.
"""

from __future__ import annotations

import re
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from rlml_slam.errors import InputError

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

MAX_LOGGED = 100  # different reasons in the log; /diagnostics count all refusals
SMALL = 65_536  # [bytes] of a message without lists: a pose, odometry, a command
LARGE = 1 << 28  # [bytes] of a map and of what belongs to it
NUMBERS = re.compile(r'[-+]?\d[\d.e+-]*|nan|inf')


class MessageGuard:
    """Counts the messages of a node that were refused, and logs each kind of reason once."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged: set[tuple[str, str]] = set()
        self.refused: Counter[str] = Counter()  # by topic
        self.unexpected: Counter[str] = Counter()  # of these, by error: each is a bug
        self.last = ''

    def pass_on(self, topic: str, use: Callable[[], Any], otherwise: Any = None) -> Any:
        """What ``use`` returns, ``otherwise`` where the message of a topic cannot be used."""
        try:
            return use()
        except InputError as e:
            self.refuse(topic, str(e))
        except Exception as e:
            self.report(topic, e)
        return otherwise

    def report(self, topic: str, error: BaseException) -> None:
        """Count an error that nobody expected, with the message of a topic that it came from."""
        reason = f'{topic}: {type(error).__name__}: {error}'
        if len(self.unexpected) < MAX_LOGGED:
            self.unexpected[reason[:200]] += 1
        self.refuse(topic, reason, ''.join(traceback.format_exception(error)))

    def refuse(self, topic: str, reason: str, trace: str = '') -> None:
        """Count a message; the reason goes to the log once, whatever numbers it has."""
        self.refused[topic] += 1
        self.last = reason[:500]
        if not self.is_new(topic, self.last, MAX_LOGGED * (2 if trace else 1)):
            return  # errors have as much room again
        if trace:
            self._logger.error(f'not used: {self.last}; please report this:\n{trace}')
        else:
            self._logger.warning(f'not used: {self.last}')

    def is_new(self, topic: str, reason: str, most: int = MAX_LOGGED) -> bool:
        """Whether a reason is to be logged: once for a topic or stream, whatever its numbers."""
        before, kind = len(self._logged), (topic, NUMBERS.sub('#', reason))
        if before < most:
            self._logged.add(kind)
        return len(self._logged) > before

    def figures(self) -> dict[str, object]:
        """Figures for /diagnostics."""
        if not self.refused:
            return {}
        counts = {f'refused on {topic}': n for topic, n in sorted(self.refused.items())}
        return {**counts, 'last refused message': self.last}


def guard_of(node: Any) -> MessageGuard:
    """The guard of a node."""
    found = getattr(node, 'message_guard', None)
    if not isinstance(found, MessageGuard):
        found = node.message_guard = MessageGuard(node.get_logger())
    return found


def listen_to_bytes(
    node: Any, kind: Any, topic: str, use: Callable[[bytes], None], qos: QoSProfile
) -> None:
    """Give ``use`` each message as it is on the wire; what it cannot use is counted."""
    guard = guard_of(node)

    def take(data: bytes) -> None:
        guard.pass_on(topic, partial(use, data))

    node.create_subscription(kind, topic, take, qos, raw=True)


def waiting(subscription: Any, kind: Any, most: int) -> Iterator[bytes]:
    """The serialized messages in the queue of a subscription, ``most`` at most, one at a time."""
    handle = subscription.handle
    with handle:
        for _ in range(most):
            taken = handle.take_message(kind, True)
            if taken is None:
                return
            yield taken[0]
            del taken  # else two are in memory


class Listener:
    """A subscription; ``use`` gets each message of at most ``largest`` bytes that can be read.

    ``options`` are those of rclpy's create_subscription.
    """

    def __init__(
        self, node: Any, kind: Any, topic: str, use: Callable[[Any], None], qos: QoSProfile,
        largest: int = SMALL, **options: Any,
    ) -> None:  # fmt: skip
        self._guard = guard_of(node)
        self._kind, self._topic, self._use, self._largest = kind, topic, use, largest
        self._depth = qos.depth
        is_sensor = not topic.startswith('rlml/')  # which is what the ends say to each other
        self._tap: Callable[[str, Any, bytes], None] | None = (
            getattr(node, 'tap', None) if is_sensor else None
        )
        self._subscription = node.create_subscription(
            kind, topic, self.receive, qos, raw=True, **options
        )
        # as it is after remapping
        self.topic_name = str(getattr(self._subscription, 'topic_name', topic))

    def receive(self, data: bytes) -> None:
        """Use one serialized message, or count it as refused."""
        self._guard.pass_on(self._topic, lambda: self._use(self._decoded(data)))

    def accept(self, msg: Any) -> None:
        """The same for a message."""
        self._guard.pass_on(self._topic, lambda: self._use(msg))

    def drain(self) -> None:
        """Use all messages that lie in the queue, in order of arrival."""
        for msg in self.drained():
            self.accept(msg)

    def drained(self) -> list[Any]:
        """All messages that lie in the queue, in order of arrival."""
        out: list[Any] = []
        for data in waiting(self._subscription, self._kind, self._depth):
            msg = self._guard.pass_on(self._topic, partial(self._decoded, data))
            if msg is not None:
                out.append(msg)
        return out

    def _decoded(self, data: bytes) -> Any:
        from rclpy.serialization import deserialize_message

        topic, kind = self._topic, self._kind.__name__
        if len(data) > self._largest:
            raise InputError(f'{topic}: {len(data)} bytes, more than {self._largest} of a {kind}')
        if self._tap is not None:
            self._tap(self.topic_name, self._kind, data)
        try:
            return deserialize_message(data, self._kind)
        except Exception as e:
            raise InputError(f'{topic}: {len(data)} bytes that are no {kind}') from e
