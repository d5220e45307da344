# SPDX-License-Identifier: Apache-2.0
"""``python -m rlml_lab.support.security_policy``: the SROS 2 policy with the nodes' topics."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from rlml_slam.cli.support.interface import IN, OUT, TOPICS

POLICY = Path(__file__).resolve().parents[2] / 'config' / 'security_policy.xml'
OWN = {'/clock', 'parameter_events', 'rosout', '~/transition_event'}  # of rclpy, in any node
NODES = {topic.node for topic in TOPICS}
DIRECTIONS = {'subscribe': IN, 'publish': OUT}


def policy(text: str) -> str:
    """The text of a policy, with the topics of TOPICS in the profile of each of their nodes."""
    out, node = [], ''
    for line in text.splitlines():
        if found := re.search(r'<profile ns="/" node="(\w+)">', line):
            node = found[1]
        topic = re.search(r'<topic>(.+)</topic>', line)
        if topic is None or node not in NODES or topic[1] in OWN:
            out.append(line)
        if (found := re.search(r'<topics (\w+)="ALLOW">', line)) and node in NODES:
            profile = node, DIRECTIONS[found[1]]
            used = [t.name for t in TOPICS if (t.node, t.direction) == profile]
            out += [f'            <topic>{name}</topic>' for name in used if name not in OWN]
    return '\n'.join(out) + '\n'


def main() -> None:
    """Print the policy."""
    sys.stdout.write(policy(POLICY.read_text(encoding='utf-8')))


if __name__ == '__main__':
    main()
