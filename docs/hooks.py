# SPDX-License-Identifier: Apache-2.0
"""Hooks of mkdocs: formulas become MathML at build time, and pages that stand in the root.

MathML is drawn by the browser itself (Firefox, Safari, Chrome from 109 on), so the site needs no
script and no network for its formulas.
"""

from __future__ import annotations

import html
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

ROOT = Path(__file__).resolve().parent.parent
# pages whose text is a file of the root, whose links lead into docs/
FROM_ROOT = {'contributing.md': 'CONTRIBUTING.md', 'changelog.md': 'CHANGELOG.md'}
FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\s*\\([(\[])(.*?)\\[)\]]\s*</(?:span|div)>', re.DOTALL
)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """The text of a page; that of a file of the root for the pages that only name one."""
    name = FROM_ROOT.get(page.file.src_uri)
    if name is None:
        return markdown
    return (ROOT / name).read_text(encoding='utf-8').replace('](docs/', '](')


def on_page_content(html: str, **_: Any) -> str:
    """The page with every LaTeX formula as MathML."""
    return FORMULA.sub(_mathml, html)


def _mathml(match: re.Match[str]) -> str:
    display = 'block' if match[2] == '[' else 'inline'
    return convert(html.unescape(match[3]).strip(), display=display)
