# SPDX-License-Identifier: Apache-2.0
"""A question to a running node, by a service that answers in words."""

from __future__ import annotations

from rlml_slam.errors import InputError

PATIENCE = 10.0  # [s] in which a running back end answers


def ask(node: str, service: str, argument: str | None = None) -> str:
    """The answer of a running back end; InputError with its words where it refuses."""
    import rclpy
    from diagnostic_msgs.srv import AddDiagnostics
    from std_srvs.srv import Trigger

    kind = Trigger if argument is None else AddDiagnostics
    request = kind.Request()
    if argument is not None:
        request.load_namespace = argument
    rclpy.init()
    try:
        asker = rclpy.create_node('rlml_ask')
        client = asker.create_client(kind, f'{node}/{service}')
        if not client.wait_for_service(PATIENCE):
            raise InputError(f'{node}: no such back end is running')
        future = client.call_async(request)
        rclpy.spin_until_future_complete(asker, future, timeout_sec=PATIENCE)
        answer = future.result() if future.done() else None
        asker.destroy_node()
    finally:
        rclpy.shutdown()
    if answer is None:
        raise InputError(f'{node}: no answer within {PATIENCE:.0f} s')
    if not answer.success:
        raise InputError(str(answer.message))
    return str(answer.message)
