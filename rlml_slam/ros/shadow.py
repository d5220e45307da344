# SPDX-License-Identifier: Apache-2.0
"""Shadow mode: a node that publishes and serves on no name that another localization may have."""

from __future__ import annotations

from typing import Any

BELOW = 'shadow'
# what a node hears from the other end; all else is from the robot and its user
OURS = ('rlml/', 'deskewed_points', 'reflectors/associated')


def name_in_shadow(name: str) -> str:
    """The name below shadow/; a private one, which begins with ~, stays."""
    return name if name.startswith('~') else f'{BELOW}/{name.lstrip("/")}'


def enter_shadow(node: Any, shadow: bool) -> None:
    """With ``shadow``, all that the node offers from now on is below shadow/, /diagnostics too."""
    if not shadow:
        return
    publish, listen, serve = node.create_publisher, node.create_subscription, node.create_service

    def create_publisher(kind: Any, topic: str, *args: Any, **options: Any) -> Any:
        return publish(kind, name_in_shadow(topic), *args, **options)

    def create_service(kind: Any, name: str, *args: Any, **options: Any) -> Any:
        return serve(kind, name_in_shadow(name), *args, **options)

    def create_subscription(kind: Any, topic: str, *args: Any, **options: Any) -> Any:
        own = topic.startswith(OURS)
        return listen(kind, name_in_shadow(topic) if own else topic, *args, **options)

    node.create_publisher = create_publisher
    node.create_service = create_service
    node.create_subscription = create_subscription
