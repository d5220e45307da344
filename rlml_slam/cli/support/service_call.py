# SPDX-License-Identifier: Apache-2.0
"""Call a service of a running node that answers with a message."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

from rlml_slam.errors import InputError
from rlml_slam.interrupts import held_interrupts

PATIENCE = 6.0  # [s] in which a service is found: DDS finds nodes one after the other
WORK = 120.0  # [s] in which it answers: to save or to search a large map takes its time


def ask(node: str, service: str, argument: str | None = None) -> str:
    """The answer of a running node; InputError with its message where it refuses."""
    from diagnostic_msgs.srv import AddDiagnostics
    from std_srvs.srv import Trigger

    kind = Trigger if argument is None else AddDiagnostics
    with asking() as asker:
        fields = {} if argument is None else {'load_namespace': argument}
        return message_of(answer_of(asker, node, service, kind, fields))


def message_of(answer: Any) -> str:
    """The message of an answer; InputError with it where the service refused."""
    if not answer.success:
        raise InputError(str(answer.message))
    return str(answer.message)


@contextlib.contextmanager
def asking(namespace: str | None = None) -> Iterator[Any]:
    """A node that asks. KeyboardInterrupt where a signal ended ROS meanwhile."""
    with held_interrupts() as check:
        import rclpy
        from rclpy._rclpy_pybind11 import RCLError
        from rclpy.exceptions import NameValidationException

        check()
    has_begun = False
    try:
        rclpy.init()
        has_begun = True
        asker = rclpy.create_node('rlml_ask', namespace=namespace)
        try:
            yield asker
        finally:
            asker.destroy_node()
    except NameValidationException as e:
        raise InputError(' '.join(str(e).split())) from e
    except Exception as e:
        if isinstance(e, RCLError) and 'DOMAIN_ID' in str(e):
            raise InputError(f'ROS_DOMAIN_ID = {domain()!r} is no domain') from e
        if not has_begun or rclpy.utilities.ok():
            raise
        raise KeyboardInterrupt from None
    finally:
        rclpy.utilities.try_shutdown()


def answer_of(asker: Any, node: str, service: str, kind: Any, fields: dict[str, Any]) -> Any:
    """The response of a service of a running node; InputError where there is none."""
    import rclpy

    client = client_of(asker, node, service, kind)
    future = client.call_async(kind.Request(**fields))
    rclpy.spin_until_future_complete(asker, future, timeout_sec=WORK)
    if not future.done() or future.result() is None:
        raise InputError(f'{node}: no answer within {WORK:.0f} s')
    return future.result()


def client_of(asker: Any, node: str, service: str, kind: Any) -> Any:
    """A client of a service of a running node; InputError where there is none."""
    node = '/' + node.strip('/')
    client = asker.create_client(kind, f'{node}/{service}')
    if not client.wait_for_service(PATIENCE):
        raise InputError(_absent(asker, node, service))
    return client


def _absent(asker: Any, node: str, service: str) -> str:
    """Why a service was not found: which nodes there are, and which have it."""
    running, having = [], []
    for full, name, namespace in others(asker):
        running.append(full)
        offered = asker.get_service_names_and_types_by_node(name, namespace)
        if f'{full}/{service}' in (offer for offer, _ in offered):
            having.append(full)
    if node in having:
        return f'{node}: its service {service} came only now, try again'
    if node in running:
        return f'{node} runs, and has no service {service}'
    if having:  # of several robots, perhaps
        return f'{node}: no such node; the service {service} is of {", ".join(sorted(having))}'
    nodes = f'there are {", ".join(sorted(running))}' if running else 'no node is running'
    return f'{node}: no such node; {nodes} (in ROS_DOMAIN_ID {domain()})'


def others(asker: Any) -> list[tuple[str, str, str]]:
    """Full name, name and namespace of the nodes that are seen."""
    seen = [(f'{s.rstrip("/")}/{n}', n, s) for n, s in asker.get_node_names_and_namespaces()]
    own = asker.get_fully_qualified_name()
    return [node for node in seen if node[0] != own and not node[1].startswith('_')]


def domain() -> str:
    """Number of the ROS domain of this process."""
    return os.environ.get('ROS_DOMAIN_ID', '0')
