# SPDX-License-Identifier: Apache-2.0
"""YAML without aliases, whose cost is bounded by the size of its text."""

from __future__ import annotations

from typing import Any

import yaml

from rlml_slam.errors import FileFormatError

MAX_CHARACTERS = 1 << 20


class PlainLoader(yaml.SafeLoader):  # type: ignore[misc]
    """Refuses aliases: ten lines with nine aliases each stand for a thousand million values."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """A node, which is no alias."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, 'an alias is not allowed here', mark)
        return super().compose_node(parent, index)


def parse_yaml(text: str, source: str) -> Any:
    """The value of a YAML text; FileFormatError names its ``source``."""
    if len(text) > MAX_CHARACTERS:
        raise FileFormatError(f'{source}: {len(text)} characters, more than {MAX_CHARACTERS}')
    try:
        return yaml.load(text, PlainLoader)
    # some values (the 99th of a month) are errors of Python's own
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as e:
        reason = str(e).splitlines() or [type(e).__name__]
        raise FileFormatError(f'{source}: not YAML: {reason[0]}') from e
