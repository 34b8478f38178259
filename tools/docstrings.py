"""Checks the package's docstrings, for ``make lint``: first word, first line, first paragraph, terms."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "splatctrl_cli"
FUNCTION_WORDS = {
    *(
        "About",
        "After",
        "Also",
        "And",
        "As",
        "At",
        "Before",
        "But",
        "By",
        "For",
        "From",
        "How",
        "If",
        "In",
        "Into",
        "It",
    ),
    *(
        "Its",
        "Of",
        "On",
        "Or",
        "So",
        "Such",
        "That",
        "Their",
        "There",
        "These",
        "They",
        "This",
        "Those",
        "To",
        "Under",
    ),
    *("Until", "Up", "What", "When", "Where", "Whether", "Which", "While", "Who", "Whose", "Why", "With", "Without"),
}
THIRD_PERSON = {  # a function's docstring begins with the imperative, or names what it returns
    *(
        "Adds",
        "Builds",
        "Checks",
        "Computes",
        "Creates",
        "Finds",
        "Gets",
        "Gives",
        "Makes",
        "Reads",
        "Returns",
        "Says",
    ),
    *("Sets", "Takes", "Tells", "Writes", "Yields"),
}
UNCLEAR = re.compile(
    r"\b(thing|things|told|said|asked|lacking|beside|nobody|somebody|comes to|goes on)\b", re.IGNORECASE
)
LONGEST_LINE, LONGEST_PARAGRAPH = 15, 60  # words
CODE, IN_BRACKETS = re.compile(r"``[^`]*``|`[^`]*`"), re.compile(r"\([^()]*\)|\[[^\[\]]*\]")
EXPLAINED = re.compile(r"\b\w+:")  # the name before what is explained


def docstrings() -> Iterator[tuple[str, str, bool]]:
    """Yield place and text of every docstring of the package, and True for a function's."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                text = ast.get_docstring(node)
                if text:
                    place = f"{path.relative_to(PACKAGE.parent)}:{getattr(node, 'lineno', 1)}"
                    yield place, text, isinstance(node, ast.FunctionDef)


def count_words(sentence: str) -> int:
    """Number of words, without shapes, units and other brackets; code counts as one word."""
    words = IN_BRACKETS.sub("", CODE.sub("code", sentence)).split()
    return sum(bool(re.search(r"\w", word)) for word in words)


def find_faults(text: str, is_function: bool) -> Iterator[str]:
    """Yield the rules that a docstring breaks."""
    line, first = text.splitlines()[0], text.split(maxsplit=1)[0]
    if first in FUNCTION_WORDS:
        yield f"first word: expected one that carries the meaning, got '{first}'"
    if is_function and first in THIRD_PERSON:
        yield f"first word: expected the imperative, got '{first}'"
    if re.match(r"[a-z]{2,} [a-z]", line):
        yield f"first word: expected a capital or code, got '{first}'"
    if not line.endswith("."):
        yield "first line: expected a full stop at its end"
    if count_words(line) > LONGEST_LINE:
        yield f"first line: expected at most {LONGEST_LINE} words, got {count_words(line)}"
    if len(text.split("\n\n", maxsplit=1)[0].split()) > LONGEST_PARAGRAPH:
        yield f"first paragraph: expected at most {LONGEST_PARAGRAPH} words"
    for word in UNCLEAR.findall(EXPLAINED.sub("", CODE.sub("", text))):
        yield f"terms: expected one of the field, got '{word}'"


def main() -> int:
    faults = [
        f"{place}: {fault}" for place, text, is_function in docstrings() for fault in find_faults(text, is_function)
    ]
    print("\n".join(faults) or "docstrings: no faults")
    return bool(faults)


if __name__ == "__main__":
    sys.exit(main())
