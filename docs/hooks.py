"""Extend mkdocs: turn names into links, formulas into MathML, and examples in docstrings into code."""

from __future__ import annotations

import html
import re
from typing import Any

import griffe

# Names outside of links; names of modules have no entry in the reference.
_NAME = re.compile(r'(?<!">)<code>(zwidth\.[\w.]+)</code>')


# Formulas on the theory pages are indented lines of plain text; runs of spaces align columns. Blocks of code differ,
# because highlighting adds elements to them.
_BLOCK = re.compile(r'<div class="highlight"><pre><span></span><code>([^<]*)</code></pre></div>')
_COLUMN = re.compile(r"\S+(?: {1,2}\S+)*")
_TOKEN = re.compile(
    r"(?P<word>[a-z]+'s\b)|(?P<name>[A-Za-z]+\d*(?:_(?:\w+|\((?=[^()]*\))[^()]*\)))?'{0,2})|(?P<number>\d+(?:\.\d+)?)|(?P<space>\s+)"
    r"|(?P<sign><=|>=|!=|->|\.\.\.|\S)"
)
# Lines of output that start with #, which Pygments highlights as a root prompt.
_COMMENT = re.compile(r'^<span class="gp"># ?</span>(.*)$', re.MULTILINE)
_TAG = re.compile(r"<[^>]*>")
# Brackets keep their size, because taller brackets would increase the line spacing.
_FLAT = ' stretchy="false"'
# Signs without additional space around them.
_CLOSE = f'{_FLAT} lspace="0" rspace="0"'
_GREEK = {
    **{"alpha": "α", "beta": "β", "gamma": "γ", "delta": "δ", "zeta": "ζ", "eta": "η", "theta": "θ", "kappa": "κ"},
    **{"xi": "ξ", "pi": "π", "rho": "ρ", "tau": "τ", "phi": "φ", "psi": "ψ", "omega": "ω", "lambda": "λ", "mu": "μ"},
    **{"sigma": "σ", "Gamma": "Γ", "Delta": "Δ", "Psi": "Ψ", "Sigma": "Σ", "Phi": "Φ"},
}
_SIGNS = {
    "<=": "≤",
    ">=": "≥",
    "!=": "≠",
    "->": "→",
    "...": "…",
    "-": "−",
    "*": "·",
    "<": "&lt;",
    ">": "&gt;",
    "&": "&amp;",
}
_UPRIGHT = frozenset(
    {
        "sin",
        "cos",
        "tan",
        "cot",
        "arg",
        "exp",
        "log",
        "ln",
        "max",
        "min",
        "Re",
        "Im",
        "sqrt",
        "sum",
        "mean",
        "integral",
        "conj",
        "num",
        "den",
    }
)


def typeset(line: str) -> str:
    """Return a formula as MathML, with powers, indices, roots and Greek letters; words remain text."""
    tokens = [(match.lastgroup or "", match.group()) for match in _TOKEN.finditer(line)]
    shown, rest = _row(tokens, 0, "")
    return f"<math>{shown}</math>" if rest == len(tokens) else f"<code>{html.escape(line)}</code>"


def _row(tokens: list[tuple[str, str]], at: int, until: str) -> tuple[str, int]:
    """Return the MathML of the tokens up to the sign ``until``, and the index of the token after it."""
    parts: list[str] = []
    while at < len(tokens) and tokens[at][1] != until:
        shown, at = _atom(tokens, at)
        while at < len(tokens) and tokens[at][1] == "^":
            if at + 1 == len(tokens) or tokens[at + 1][0] == "space" or tokens[at + 1][1] == ")":
                shown, at = f"<mover>{shown}<mo>^</mo></mover>", at + 1
                continue
            power, at = _atom(tokens, at + 1, bare=True)
            shown = f"<msup>{shown}{power}</msup>"
        parts.append(shown)
    return f"<mrow>{''.join(parts)}</mrow>", at + bool(until)


def _atom(tokens: list[tuple[str, str]], at: int, bare: bool = False) -> tuple[str, int]:
    """Return the MathML of one name, number, sign or group, and the index of the next token.

    A ``bare`` group has no parentheses.
    """
    kind, text = tokens[at]
    if kind == "space":
        # Wide gaps separate formulas on one line; narrow gaps keep the alignment of signs in columns.
        parts = len(text) > 1 and tokens[at - 1][1] == ","
        return f'<mspace width="{"2em" if parts else "0.2em"}"/>', at + 1
    if kind == "number":
        return f"<mn>{text}</mn>", at + 1
    if text == "sqrt" and tokens[at + 1 : at + 2] == [("sign", "(")]:
        inside, behind = _row(tokens, at + 2, ")")
        return f"<msqrt>{inside}</msqrt>", behind
    if kind == "word":
        return f"<mtext>{text}</mtext>", at + 1
    if kind == "name":
        return _name(text), at + 1
    if text == "-" and bare:
        inside, behind = _atom(tokens, at + 1, bare=True)
        return f"<mrow><mo>−</mo>{inside}</mrow>", behind
    if text in "({[":
        close = {"(": ")", "{": "}", "[": "]"}[text]
        inside, behind = _row(tokens, at + 1, close)
        return (inside if bare else f"<mrow><mo{_FLAT}>{text}</mo>{inside}<mo{_FLAT}>{close}</mo></mrow>"), behind
    return f"<mo{_CLOSE if text in '|/' else ''}>{_SIGNS.get(text, text)}</mo>", at + 1


def _name(text: str) -> str:
    """Return the MathML of a quantity with its index and primes, of an operator, or of a word."""
    base, _, index = text.rstrip("'").partition("_")
    primes = text[len(text.rstrip("'")) :]
    stem = base.rstrip("0123456789")
    index = index.strip("()") or base[len(stem) :]
    if stem in _UPRIGHT:
        shown = f'<mi mathvariant="normal">{stem}</mi>' if stem != "integral" else "<mo>∫</mo>"
    elif stem in _GREEK or len(stem) == 1:
        shown = f"<mi>{_GREEK.get(stem, stem)}</mi>"
    elif len(stem) == 2 and (stem[0] in "cdgj" or index or primes):
        shown = f"<mrow>{''.join(f'<mi>{letter}</mi>' for letter in stem)}</mrow>"
    else:
        return f"<mtext>{text}</mtext>"
    if index:
        low = "".join(_GREEK.get(part, part) for part in re.split(r"([A-Za-z]+)", index))
        kind = "mi" if len(low) == 1 and low.isalpha() else "mn"
        shown = f"<msub>{shown}<{kind}>{low}</{kind}></msub>"
    return f"<msup>{shown}<mo>{'′' * len(primes)}</mo></msup>" if primes else shown


def _lay(block: re.Match[str]) -> str:
    """Return lines of formulas as a grid that keeps their columns."""
    lines = [html.unescape(line) for line in block[1].rstrip("\n").split("\n")]
    pieces = [[(piece.start(), piece.group()) for piece in _COLUMN.finditer(line)] for line in lines]
    starts = sorted({start for line in pieces for start, _ in line})
    cells = ""
    for row, line in enumerate(pieces, 1):
        ends = [starts.index(start) + 1 for start, _ in line[1:]] + [len(starts) + 1]
        for (start, text), end in zip(line, ends, strict=False):
            place = f"grid-area: {row} / {starts.index(start) + 1} / {row + 1} / {end}"
            cells += f'<div style="{place}">{typeset(text)}</div>'
    return f'<div class="formulas{" single" if len(lines) == 1 else ""}">{cells}</div>'


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Set the language of doctest examples to pycon, so that prompts and output have separate CSS classes."""
    return markdown.replace("```python\n>>> ", "```pycon\n>>> ")


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Link `zwidth.name` to its entry in the reference, if it has one, and typeset the formulas of the theory."""
    if page.file.src_uri.startswith("theory/"):
        html = _BLOCK.sub(_lay, html)
    html = _COMMENT.sub(lambda line: f'<span class="go"># {_TAG.sub("", line[1])}</span>', html)
    return _NAME.sub(r'<autoref identifier="\1" optional>\g<0></autoref>', html)


class Docstrings(griffe.Extension):
    """Convert docstrings from plain text to Markdown."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rename sections to the names of mkdocstrings, omit repeated types, and escape ">" at the start of a line."""
        if obj.docstring:
            text = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
            # The signature contains the type of the result.
            text = re.sub(r"^( *Returns:\n +)[A-Z]\w+: ", r"\1", text, flags=re.MULTILINE)
            obj.docstring.value = re.sub(r"^( *)>(?!>)", r"\1\\>", text, flags=re.MULTILINE)
