# SPDX-License-Identifier: Apache-2.0
"""Errors of the clients of stores, as errors that name the place."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rlml_slam.errors import MapError, RlmlError


@contextmanager
def naming(url: str, what: str, kind: type[RlmlError] = MapError) -> Iterator[None]:
    """An error inside becomes one of ``kind`` that says which ``url`` ``what``, and why.

    Every client of a store has errors of its own, which need not be OSError: no route, wrong
    credentials, no such bucket.
    """
    try:
        yield
    except (RlmlError, AssertionError, AttributeError, NameError, IndexError):
        raise  # ours: said already, or a bug
    except Exception as e:
        raise kind(f'{url}: {what}: {e}') from e
