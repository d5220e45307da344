# SPDX-License-Identifier: Apache-2.0
"""Call a service of a running node that answers with a message."""

from __future__ import annotations

from typing import Any

from rlml_slam.errors import InputError

PATIENCE = 10.0  # [s] in which a running node is found
WORK = 120.0  # [s] in which it answers: to save or to search a large map takes its time


def ask(node: str, service: str, argument: str | None = None) -> str:
    """The answer of a running node; InputError with its message where it refuses."""
    from diagnostic_msgs.srv import AddDiagnostics
    from std_srvs.srv import Trigger

    if argument is None:
        return message_of(call(node, service, Trigger, {}))
    return message_of(call(node, service, AddDiagnostics, {'load_namespace': argument}))


def message_of(answer: Any) -> str:
    """The message of an answer; InputError with it where the service refused."""
    if not answer.success:
        raise InputError(str(answer.message))
    return str(answer.message)


def call(node: str, service: str, kind: Any, fields: dict[str, Any]) -> Any:
    """The response of a service of a running node; InputError where there is none."""
    import rclpy

    rclpy.init()
    try:
        asker = rclpy.create_node('rlml_ask')
        client = asker.create_client(kind, f'{node}/{service}')
        if not client.wait_for_service(PATIENCE):
            raise InputError(f'{node}: no node with the service {service} is running')
        future = client.call_async(kind.Request(**fields))
        rclpy.spin_until_future_complete(asker, future, timeout_sec=WORK)
        answer = future.result() if future.done() else None
        asker.destroy_node()
    finally:
        rclpy.shutdown()
    if answer is None:
        raise InputError(f'{node}: no answer within {WORK:.0f} s')
    return answer
