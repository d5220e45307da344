# SPDX-License-Identifier: Apache-2.0
"""A study's page: one HTML file with tables and pictures that needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

from rlml_slam.version import __version__

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1100px; margin: 2em auto; padding: 0 1em;
       color: #24292f; background: #fff; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; margin: 0 0 1em; }
th, td { padding: .25em .8em; border-bottom: 1px solid #e3e6ea; text-align: right; }
th:first-child, td:first-child { text-align: left; }
th { color: #6a737d; font-weight: normal; } h2 { font-size: 1.15em; margin-top: 1.8em; }
img { max-width: 100%; display: block; } .wide { overflow-x: auto; }
footer { color: #6a737d; font-size: 13px; margin-top: 2em; }
"""


def page(title: str, lead: str, parts: Sequence[str]) -> str:
    """The whole file from sections, tables and pictures."""
    body = '\n'.join(parts)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{escape(title)} · rlml_slam</title><style>{_STYLE}</style></head>\n'
        f'<body><h1>{escape(title)}</h1><p>{escape(lead)}</p>\n{body}\n'
        f'<footer>rlml_slam {__version__}</footer></body></html>\n'
    )


def heading(text: str) -> str:
    """The heading of a section."""
    return f'<h2>{escape(text)}</h2>'


def paragraph(text: str) -> str:
    """A paragraph of plain text."""
    return f'<p>{escape(text)}</p>'


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose first column is names and whose others are figures."""
    head = ''.join(f'<th>{escape(h)}</th>' for h in header)
    body = ''.join(
        '<tr>' + ''.join(f'<td>{escape(c)}</td>' for c in row) + '</tr>' for row in rows
    )
    return f'<div class="wide"><table><tr>{head}</tr>{body}</table></div>'


def picture(png: bytes, caption: str) -> str:
    """A PNG inside the page."""
    data = base64.b64encode(png).decode('ascii')
    alt = escape(caption)
    return f'<img alt="{alt}" src="data:image/png;base64,{data}"><p>{alt}</p>'
