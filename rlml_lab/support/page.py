# SPDX-License-Identifier: Apache-2.0
"""A study's page, in the style of the report: tables and pictures in one HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from rlml_slam.report import page as skeleton


def page(title: str, lead: str, parts: Sequence[str]) -> str:
    """The whole file from sections, tables and pictures."""
    return skeleton.page(title, [skeleton.heading(title, lead), *parts])


def heading(text: str) -> str:
    """The heading of a section."""
    return f'<h2>{escape(text)}</h2>'


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f'<p>{escape(text)}</p>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose first column is names and whose others are figures."""
    return skeleton.table(rows, header)


def picture(png: bytes, caption: str) -> str:
    """A PNG inside the page."""
    return (
        f'<figure>{skeleton.picture(png, caption)}<figcaption>{escape(caption)}</figcaption>'
        '</figure>'
    )
