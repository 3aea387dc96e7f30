"""Docstrings begin with a verb or a noun phrase, never with a question word."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("league", "dashboards", "agents", "matchmaking", "arenas", "storage")
QUESTION = re.compile(r"(Who|Whom|Whose|What|Whether|How|Where|Which|When|Why|By that|Of which)\b")


def docstrings(source: str) -> list[tuple[int, str]]:
    """Return (line, text) of all docstrings, those under fields and constants included."""
    return [
        (node.lineno, node.value.value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]


def test_a_question_is_noticed_wherever_it_stands():
    source = (
        '"""Which one."""\nclass A:\n    x: int = 0\n    """How many."""\n\n    def f(self):\n        """Return."""\n'
    )
    assert [line for line, text in docstrings(source) if QUESTION.match(text)] == [1, 4]


@pytest.mark.parametrize("package", PACKAGES)
def test_docstrings_begin_with_no_question(package):
    found = [
        f"{file.relative_to(ROOT)}:{line}: {text.partition(chr(10))[0]}"
        for file in sorted((ROOT / package).rglob("*.py"))
        for line, text in docstrings(file.read_text("utf-8"))
        if QUESTION.match(text.strip())
    ]
    assert not found, "\n".join(found)
