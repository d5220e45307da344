# SPDX-License-Identifier: Apache-2.0
"""The one place that every message of a node passes: one that cannot be used costs only itself."""

from __future__ import annotations

import re
import traceback
from collections import Counter
from collections.abc import Callable
from typing import Any

from rlml_slam.errors import InputError

MAX_LOGGED = 100  # different reasons in the log; /diagnostics count all refusals
NUMBERS = re.compile(r'[-+]?\d[\d.e+-]*|nan|inf')


class MessageGuard:
    """Counts the messages of a node that were refused, and logs each kind of reason once."""

    def __init__(self, logger: Any) -> None:
        self._logger = logger
        self._logged: set[tuple[str, str]] = set()
        self.refused: Counter[str] = Counter()  # by topic
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
        self.refuse(topic, reason, ''.join(traceback.format_exception(error)))

    def refuse(self, topic: str, reason: str, trace: str = '') -> None:
        """Count a message; the reason goes to the log once, whatever numbers it has."""
        self.refused[topic] += 1
        self.last = reason[:500]
        kind = (topic, NUMBERS.sub('#', self.last))
        if kind in self._logged or len(self._logged) >= MAX_LOGGED:
            return
        self._logged.add(kind)
        if trace:
            self._logger.error(f'not used: {self.last}; please report this:\n{trace}')
        else:
            self._logger.warning(f'not used: {self.last}')

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


def checked(node: Any, topic: str, callback: Callable[[Any], None]) -> Callable[[Any], None]:
    """The callback, which counts a message that cannot be used instead of raising."""
    guard = guard_of(node)
    return lambda msg: guard.pass_on(topic, lambda: callback(msg))
