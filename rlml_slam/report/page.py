# SPDX-License-Identifier: Apache-2.0
"""The skeleton of every HTML page: one file that carries its style and needs nothing else."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from rlml_slam.version import __version__


def page(
    title: str, parts: Sequence[str], footer: Mapping[str, str] | None = None, head: str = ''
) -> str:
    """A whole page of these parts, which are HTML, as ``head`` is.

    ``footer`` has names and values, as text, that follow the version.
    """
    style = (Path(__file__).parent / 'page.css').read_text(encoding='utf-8')
    rows = {'version': f'rlml_slam {__version__}'} | dict(footer or {})
    last = ''.join(
        f'<dt>{escape(k)}</dt><dd><code>{escape(v)}</code></dd>' for k, v in rows.items()
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<link rel="icon" href="data:,">'
        f'<title>{escape(title)} · rlml_slam</title><style>{style}</style>{head}</head>\n'
        '<body><main>\n' + '\n'.join(parts) + f'\n<footer><dl>{last}</dl></footer></main></body>'
        '</html>\n'
    )


def heading(title: str, sub: str) -> str:
    """The title of the page, and a line below it."""
    return f'<h1>{escape(title)}</h1><p class="sub">{escape(sub)}</p>'


def section(title: str, body: str, kind: str = '', what: str = '') -> str:
    """A box of the page; ``body`` is HTML, ``what`` explains it in plain text."""
    above = f'<h2>{escape(title)}</h2>' if title else ''
    above += f'<p class="what">{escape(what)}</p>' if what else ''
    return f'<section class="{kind}">{above}{body}</section>'


def table(rows: Sequence[Sequence[str]], head: Sequence[str] = (), kind: str = '') -> str:
    """Rows of text; without a ``head``, the first cell of each row is its name."""
    escaped = [[escape(c) for c in row] for row in rows]
    return html_table(escaped, [escape(c) for c in head], kind)


def headed_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of text, of which the first is the head."""
    return table(rows[1:], rows[0])


def html_table(rows: Sequence[Sequence[str]], head: Sequence[str] = (), kind: str = '') -> str:
    """As ``table``, of cells that are HTML."""
    first = 'td' if head else 'th'
    body = ''.join(
        f'<tr><{first}>{name}</{first}>{"".join(f"<td>{c}</td>" for c in others)}</tr>'
        for name, *others in rows
    )
    top = ''.join(f'<th>{c}</th>' for c in head)
    top = f'<thead><tr>{top}</tr></thead>' if head else ''
    return f'<div class="wide"><table class="{kind}">{top}<tbody>{body}</tbody></table></div>'


def picture(png: bytes, caption: str) -> str:
    """A PNG inside the page."""
    data = base64.b64encode(png).decode('ascii')
    return f'<img alt="{escape(caption)}" src="data:image/png;base64,{data}">'
