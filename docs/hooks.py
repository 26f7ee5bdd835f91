"""Hooks of the documentation's build: parts made from the code, formulas as MathML, diagrams in the page.

Browsers render MathML themselves, so formulas need no script; long ones are cut into terms that wrap. A
diagram inside the page takes the page's colours, in light and dark mode.
"""

import html
import importlib.util
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert

HERE = Path(__file__).parent
_FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
_TABLE = re.compile(r"<table>.*?</table>", re.DOTALL)
_CODE = re.compile(r"<code>[^<]*</code>")
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
    return _TABLE.sub(_breakable, _DIAGRAM.sub(_diagram, _FORMULA.sub(_formula, text)))


def _breakable(table: re.Match[str]) -> str:
    """A table whose names may break after an underscore or a point, and nowhere else."""
    return _CODE.sub(lambda code: re.sub(r"([_.])(?=\w)", r"\1<wbr>", code[0]), table[0])


def _formula(match: re.Match[str]) -> str:
    tex = html.unescape(match[3]).strip()
    if match[2] == "(":
        return str(convert(tex, display="inline"))
    parts = _parts(tex)
    if len(parts) == 1:
        return str(convert(tex, display="block"))
    # Browsers break no line inside a formula; "{}" makes of the first sign one between two terms.
    terms = [convert(part if k == 0 else f"{{}} {part}", display="block") for k, part in enumerate(parts)]
    return f'<div class="formula">{" ".join(terms)}</div>'


def _parts(tex: str) -> list[str]:
    """A formula, cut before each sign of relation or sum that stands outside all brackets."""
    parts, depth = [""], 0
    for token in re.findall(r"\\[a-zA-Z]+|\\.|.", tex, re.DOTALL):
        depth += token in ("{", "(", "[", r"\left") or -(token in ("}", ")", "]", r"\right"))
        if depth == 0 and token in "+-=" and parts[-1].strip():
            parts.append("")
        parts[-1] += token
    return parts


def _diagram(match: re.Match[str]) -> str:
    svg = (HERE / "pictures" / match[2]).read_text(encoding="utf-8")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{match[1]}" ', 1)
