"""Hooks of the documentation's build: parts made from the code, formulas as MathML, diagrams in the page.

Browsers render MathML themselves, so formulas need no script. A diagram inside the page takes the page's
colours, in light and dark mode.
"""

from __future__ import annotations

import html
import importlib.util
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

HERE = Path(__file__).parent
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_DIAGRAM = re.compile(r'<img alt="([^"]*)" class="diagram" src="(?:\.\./)*pictures/([\w-]+\.svg)"\s*/?>')


def on_page_markdown(text: str, **_: Any) -> str:
    """Fill in the parts that a page asks for (docs/generate.py)."""
    specification = importlib.util.spec_from_file_location("generate", HERE / "generate.py")
    assert specification is not None and specification.loader is not None
    generate = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(generate)
    return str(generate.filled(text))


def on_page_content(text: str, **_: Any) -> str:
    """Render what Markdown has left to do."""
    return _DIAGRAM.sub(_diagram, _FORMULA.sub(_formula, text))


def _formula(match: re.Match[str]) -> str:
    display = "inline" if match[2] == "(" else "block"
    return str(convert(html.unescape(match[3]), display=display))


def _diagram(match: re.Match[str]) -> str:
    svg = (HERE / "pictures" / match[2]).read_text(encoding="utf-8")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{match[1]}" ', 1)
