# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy allows what the nodes do."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from rlml_slam.cli.support.interface import IN, OUT, SERVICES, TOPICS

POLICY = Path(__file__).resolve().parents[1] / 'config' / 'security_policy.xml'
NODES = sorted({topic.node for topic in TOPICS})

LIFECYCLE = {
    f'~/{name}'
    for name in (
        'change_state', 'get_state', 'get_available_states', 'get_available_transitions',
        'get_transition_graph',
    )
}  # fmt: skip


def allowed(node, what):
    """Names of a node's profile that are published, subscribed to or answered."""
    root = ElementTree.parse(POLICY).getroot()
    (enclave,) = root.findall(f".//enclave[@path='/rlml_slam/{node}']")
    (profile,) = enclave.findall(f".//profile[@node='{node}']")
    return {e.text for e in profile.findall(f'./*[@{what}="ALLOW"]/*')}


@pytest.mark.parametrize('node', NODES)
@pytest.mark.parametrize(('direction', 'what'), [(IN, 'subscribe'), (OUT, 'publish')])
def test_topics_of_a_node_are_allowed(node, direction, what):
    used = {t.name for t in TOPICS if t.node == node and t.direction == direction}
    own = {'/clock', 'parameter_events', 'rosout', '~/transition_event'}
    assert used <= allowed(node, what) <= used | own


@pytest.mark.parametrize('node', NODES)
def test_services_of_a_node_are_allowed(node):
    offered = {s.name for s in SERVICES if s.node == node}
    extra = allowed(node, 'reply') - offered
    assert offered <= allowed(node, 'reply')
    assert extra >= (set() if node == 'simulator' else LIFECYCLE)
    assert all('parameter' in name for name in extra - LIFECYCLE)
