# SPDX-License-Identifier: Apache-2.0
"""tf2's own buffer as a child process: Debian's python3-tf2, whose rules ROS 2 kept.

It needs ROS 1's messages, which have the names of ROS 2's: so it runs in the system's Python,
which runs this file as a script, and is spoken to by lines.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

PYTHON = '/usr/bin/python3'
INSTALL = 'apt-get install python3-tf2'
KEPT = 10  # [s], tf2's default
NANO = 1_000_000_000


def is_installed() -> bool:
    """Whether the system's Python has tf2."""
    if not Path(PYTHON).exists():
        return False
    command = [PYTHON, '-I', '-c', 'import tf2_py, rospy, geometry_msgs.msg']
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


class BufferCore:
    """Transforms and questions go to the child process in the order of the calls.

    ``why`` is what tf2 said of the last question, where it was refused.
    """

    why = ''

    def __enter__(self) -> BufferCore:
        self._child = subprocess.Popen(
            [PYTHON, '-I', __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._child.communicate()

    def add(
        self, stamp: int, edge: tuple[str, str], p: Iterable[float], q: Iterable[float]
    ) -> None:
        """A transform of (parent, child): position (3,) and quaternion (4,), w last."""
        self._send('add', stamp, *edge, *map(repr, map(float, (*p, *q))))

    def ask(self, stamp: int, edge: tuple[str, str]) -> list[float] | None:
        """Position and quaternion of T_a_b at a stamp; None where it is refused."""
        self._send('ask', stamp, *edge)
        self._child.stdin.flush()  # type: ignore[union-attr]
        what, _, said = self._child.stdout.readline().partition(' ')  # type: ignore[union-attr]
        self.why = '' if what == 'found' else said.strip()
        return [float(w) for w in said.split()] if what == 'found' else None

    def _send(self, *words: Any) -> None:
        print(*words, file=self._child.stdin)


def _serve() -> None:
    import geometry_msgs.msg
    import rospy  # type: ignore[import-not-found]
    import tf2_py  # type: ignore[import-not-found]

    core = tf2_py.BufferCore(rospy.Duration(KEPT))
    for line in sys.stdin:
        what, stamp, a, b, *numbers = line.split()
        time = rospy.Time(*divmod(int(stamp), NANO))
        if what == 'add':
            m: Any = geometry_msgs.msg.TransformStamped()
            m.header.stamp, m.header.frame_id, m.child_frame_id = time, a, b
            t, r = m.transform.translation, m.transform.rotation
            t.x, t.y, t.z, r.x, r.y, r.z, r.w = map(float, numbers)
            core.set_transform(m, 'default_authority')
        else:
            try:
                m = core.lookup_transform_core(a, b, time)
            except tf2_py.TransformException as e:
                print('refused', e, flush=True)
                continue
            t, r = m.transform.translation, m.transform.rotation
            print('found', t.x, t.y, t.z, r.x, r.y, r.z, r.w, flush=True)


if __name__ == '__main__':
    _serve()
