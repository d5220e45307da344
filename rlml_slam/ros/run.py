# SPDX-License-Identifier: Apache-2.0
"""What every executable does around its node: start, spin, stop; a user's mistake is one line."""

from __future__ import annotations

import gc
import signal
import sys
from collections.abc import Callable
from typing import Any

import rclpy.utilities
from rclpy._rclpy_pybind11 import RCLError
from rclpy.exceptions import InvalidNodeNameException, NameValidationException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from rlml_slam.errors import FileFormatError, MapError, RlmlError
from rlml_slam.ros.memory import keep_large_apart
from rlml_slam.ros.message_guard import guard_of
from rlml_slam.ros.usage import answered

WAIT = 0.2  # [s] after which a signal is looked for where nothing comes


class Signals:
    """SIGINT, SIGTERM, SIGHUP: end the spinning, or what comes before it at once.

    Those of rclpy take the topics away first, and whoever still publishes or logs fails. While
    ``is_held``, a signal is only noted: a node that is interrupted while it begins its threads
    would leave them running, and the process with them.
    """

    came = is_held = False

    def install(self) -> None:
        """Take over the signals of this process."""
        self.came = self.is_held = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup wants it
            signal.signal(signal.SIGHUP, self._on_signal)

    def _on_signal(self, _number: int, _frame: object) -> None:
        self.came = True
        if not self.is_held:
            raise KeyboardInterrupt


SIGNALS = Signals()


def run(*factories: Callable[[], Any]) -> int:
    """Spin the nodes until they ask to end or a signal comes; the exit code.

    A node ends the run by raising SystemExit in a callback. A signal ends it with 0.
    """
    try:
        code = answered(factories[0], sys.argv)
        if code is not None:
            return code
        keep_large_apart()
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    except RCLError as e:
        print(f'rlml_slam: {_cause(e)}', file=sys.stderr)
        return 1
    nodes: list[Any] = []
    executor = SingleThreadedExecutor()
    try:
        SIGNALS.install()
        for factory in factories:
            nodes.append(factory())
            executor.add_node(nodes[-1])
            SIGNALS.is_held = False
            if SIGNALS.came:
                raise KeyboardInterrupt
        # what is there now stays: looking through all of it again and again would hold up poses
        gc.freeze()
        SIGNALS.is_held = True
        _spin(executor, nodes)
    except (RlmlError, NameValidationException, InvalidNodeNameException) as e:
        print(f'rlml_slam: {e}', file=sys.stderr)
        return 1
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RCLError:
        # a signal may end the context in the middle of a callback
        if rclpy.utilities.ok():
            raise
    except SystemExit as e:
        return int(e.code or 0)
    finally:
        SIGNALS.is_held = True
        for node in nodes:
            node.destroy_node()
        executor.shutdown(timeout_sec=1.0)
        rclpy.utilities.try_shutdown()
    return 0


def _spin(executor: Any, nodes: list[Any]) -> None:
    """Spin; an error that nobody expected is logged, and the nodes go on.

    What they have mapped is worth more than a process that ends.
    """
    while rclpy.utilities.ok() and not SIGNALS.came:
        try:
            executor.spin_once(timeout_sec=WAIT)
        except (MapError, FileFormatError, ExternalShutdownException):
            raise  # a map that a parameter names cannot be used, or a signal came
        except Exception as e:
            if not rclpy.utilities.ok():
                raise
            guard_of(nodes[-1]).report('any topic', e)


def _cause(error: Exception) -> str:
    """The first line of rcl's message, which names the argument or the file."""
    cause = str(error).strip().splitlines()[0].split(', at ')[0]
    mixed = 'same type' in cause
    return f'{cause}; write all numbers alike, such as [0.2, 0.0, 0.0]' if mixed else cause
