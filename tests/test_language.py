"""The language stays plain: few forbidden constructions in texts and documents, noun phrases in errors."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

PROJECT = Path(__file__).resolve().parent.parent
PACKAGES = ("bench", "sim", "drivers")

CEILINGS = {
    "anew": 0,
    "is none": 9,
    "told|tells|tell": 4,
    "heard|hears|hear": 0,
    "greatest": 3,
    "somebody|nobody|whoever": 0,
    "what is": 0,
    "wish|wishes": 1,
}
"""Max occurrences of each in docstrings and messages of PACKAGES: lower them, never raise them."""

CONSTRUCTIONS = {
    r"\bwhat (a|an|the|it|is|was|no|only|comes?|came|lies|must|may|does|did|can|has|had|holds|follows|remains"
    r"|needs|keeps)\b": (8, 2, 2),
    r"\bbeside\b": (5, 3, 0),
    r"\bby (itself|themselves)\b": (0, 0, 1),
    r"\b(go|goes|going|went) on\b": (0, 0, 0),
    r"\bbegun\b|\b(its|the|a) begin\b": (0, 1, 0),
    r"\bask(s|ed)? (for \w+ )?again\b|\basked for\b": (0, 0, 0),
    r"\b(nobody|somebody|anybody|whoever)\b": (2, 0, 5),
    r"\bof (before|then|now)\b": (0, 0, 0),
    r"\blets? (in|go|off)\b": (0, 0, 1),
    r"\b(of|on) (its|their) own\b": (6, 2, 4),
    r", too\b": (0, 0, 0),
    r"\b(told|tells?|hear[sd]?)\b": (1, 4, 2),
    r"\b(is|are|was|were) (named|told|believed|doubted|let|swung|meant)\b": (1, 2, 1),
    r"(?:^|[.:;] )(Of|Beside|Out of) [a-z]": (4, 3, 5),
    r"\b(swung|swing(s|ing)?) (the )?spools?\b|\bspools? (is|are) swung\b": (0, 0, 0),
    r"\b(until now|shipped before|as before|had been)\b": (0, 0, 0),
}
"""Max occurrences in hand-written documents, strings of PACKAGES, and strings of tests: never raise them."""

MAX_SHORT_ACTIONS = 0
"""Errors whose action has at most three words and no value."""
MAX_CLAUSES = 0
"""Errors that expect "it …", "to …", "this …" or "one"."""
MAX_NOTHINGS = 0
"""Errors that found "nothing" where a value is missing."""

MAX_LINES = 60
WHOLE = {
    "sim/dynamics.py:_derivative",
    "sim/kane.py:kane_terms_at",
    "sim/plant.py:advance",
    "bench/design/optimal_control.py:solve_downswing",
}
"""Longer functions that read better whole: derivations, one tick's integration, the collocation problem."""

MAX_WORDS = 23_990
"""Of all hand-written documents; bars and rules of tables are none."""

MAX_LONG_SENTENCES = 34
"""Sentences of docstrings with more than 30 words; the rest are lists and formulas."""

MAX_SKIPS = 9
"""Tables that the formatter is kept from."""


@cache
def parsed() -> dict[str, ast.Module]:
    """Return the modules of PACKAGES by path."""
    paths = sorted(path for package in PACKAGES for path in (PROJECT / package).rglob("*.py"))
    return {str(path.relative_to(PROJECT)): ast.parse(path.read_bytes()) for path in paths}


@cache
def walked() -> dict[str, list[ast.AST]]:
    """Return all nodes of each of these modules: a walk takes as long as parsing."""
    return {path: list(ast.walk(tree)) for path, tree in parsed().items()}


@cache
def texts() -> tuple[str, ...]:
    """Return all strings of more than one word: docstrings and messages."""
    return tuple(strings_of(node for nodes in walked().values() for node in nodes))


@cache
def names_and_texts() -> tuple[frozenset[str], tuple[str, ...]]:
    """Return names of all functions of tests, and texts of all tests but this one; no module is kept."""
    names, texts = set[str](), list[str]()
    for path in (PROJECT / "tests").rglob("*.py"):
        nodes = list(ast.walk(ast.parse(path.read_bytes())))
        names |= {node.name for node in nodes if isinstance(node, ast.FunctionDef)}
        texts += strings_of(nodes) if path.name != Path(__file__).name else ()
    return frozenset(names), tuple(texts)


def strings_of(nodes: Iterable[ast.AST]) -> Iterator[str]:
    """Yield the strings of more than one word in `nodes`."""
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.value


@cache
def documents() -> tuple[str, ...]:
    """Return the hand-written parts of all documents but the changelog."""
    skipped = ("FAULTS.md", "HAZARDS.md", "CHANGELOG.md")
    paths = [path for path in PROJECT.rglob("*.md") if path.name not in skipped and ".venv" not in path.parts]
    generated = re.compile(r"<!-- ([\w ]+): begin -->.*?<!-- \1: end -->", re.DOTALL)
    written = (path for path in paths if not {"data", "results"} & set(path.parts))
    return tuple(generated.sub("", path.read_text()) for path in written)


def errors() -> Iterator[list[str | None]]:
    """Yield found, expected and action of each error that is made of literals; None: of something else."""
    kinds = {"BenchError"}
    classes = [n for nodes in walked().values() for n in nodes if isinstance(n, ast.ClassDef)]
    while more := {c.name for c in classes if kinds & {ast.unparse(base) for base in c.bases}} - kinds:
        kinds |= more
    for nodes in walked().values():
        for node in nodes:
            if isinstance(node, ast.Call) and ast.unparse(node.func) in kinds and len(node.args) > 3:
                yield [literal(argument) for argument in node.args[1:4]]


def literal(node: ast.expr) -> str | None:
    """Return the text of a literal, with {} for values."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(v.value) if isinstance(v, ast.Constant) else "{}" for v in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else None


@pytest.mark.parametrize(("pattern", "ceilings"), CONSTRUCTIONS.items())
def test_forbidden_constructions_stay_within_ceilings(pattern: str, ceilings: tuple[int, int, int]) -> None:
    compiled = re.compile(pattern, re.IGNORECASE | re.MULTILINE)
    found = [
        sum(len(compiled.findall(text)) for text in group)
        for group in (documents(), texts(), names_and_texts()[1])
    ]
    assert [count for count, most in zip(found, ceilings, strict=True) if count > most] == []


def test_documents_stay_within_word_limit() -> None:
    assert sum(bool(re.search(r"\w", word)) for text in documents() for word in text.split()) <= MAX_WORDS


def test_bench_errors_have_noun_phrases_and_actions() -> None:
    parts = list(errors())
    assert len(parts) > 300
    short = [action for *_, action in parts if action and len(action.split()) <= 3 and "{}" not in action]
    clauses = [
        expected for _, expected, _ in parts if expected and re.match(r"it |to |this |(it|one)$", expected)
    ]
    nothings = [found for found, _, _ in parts if found == "nothing"]
    assert len(short) <= MAX_SHORT_ACTIONS, short
    assert len(clauses) <= MAX_CLAUSES
    assert len(nothings) <= MAX_NOTHINGS


def test_test_names_have_no_articles_or_pronouns() -> None:
    words = {"a", "an", "the", "it", "its", "nobody", "somebody", "whoever", "told", "said", "beside", "too"}
    assert [
        name for name in names_and_texts()[0] if name.startswith("test_") and words & set(name.split("_"))
    ] == []


@pytest.mark.parametrize(("words", "ceiling"), CEILINGS.items())
def test_vague_words_stay_within_ceilings(words: str, ceiling: int) -> None:
    pattern = re.compile(rf"\b({words})\b", re.IGNORECASE)
    assert sum(len(pattern.findall(text)) for text in texts()) <= ceiling


def test_public_classes_are_defined_once() -> None:
    names = Counter(
        node.name
        for tree in parsed().values()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_functions_stay_within_line_limit() -> None:
    long = {
        f"{path}:{node.name}"
        for path, nodes in walked().items()
        for node in nodes
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno >= MAX_LINES
    }
    assert long == WHOLE


def field_docstrings() -> Iterator[tuple[str, str]]:
    """Yield path and line, and the docstring, of each field and constant of PACKAGES."""
    for path, nodes in walked().items():
        for node in nodes:
            body = node.body if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) else []
            for assigned, after in pairwise(body):
                match assigned, after:
                    case ast.Assign() | ast.AnnAssign(), ast.Expr(value=ast.Constant(value=str(text))):
                        yield f"{path}:{after.lineno}", text


def test_field_docstrings_begin_with_noun() -> None:
    words = (
        "s|m|rad|Pa|m/s|rad/s|ms|ns|J|Of|By|In|To|For|From|With|Without|At|Beyond|Below|Above|As|Where|After"
        "|Before|What"
    )
    texts = list(field_docstrings())
    assert len(texts) > 2000
    assert [place for place, text in texts if re.match(rf"({words})\b", text)] == []


def test_docstring_sentences_have_at_most_thirty_words() -> None:
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef)
    found = (node for nodes in walked().values() for node in nodes if isinstance(node, documented))
    sentences = (s for node in found for s in re.split(r"(?<=[.:;])\s", ast.get_docstring(node) or ""))
    assert len([s for s in sentences if len(s.split()) > 30]) <= MAX_LONG_SENTENCES


def test_limits_are_named_min_or_max() -> None:
    pattern = re.compile(r"_?(LONGEST|SHORTEST|LEAST|MOST|GREATEST|SLOWEST|FASTEST)(_[A-Z_]+)?$")
    names = {
        f"{path}:{node.id}"
        for path, nodes in walked().items()
        for node in nodes
        if isinstance(node, ast.Name) and pattern.match(node.id)
    }
    assert names == set()


def test_formatter_skips_stay_within_limit() -> None:
    mark = "# fmt: " + "skip"
    files = [path for folder in (*PACKAGES, "tests") for path in (PROJECT / folder).rglob("*.py")]
    assert sum(path.read_text().count(mark) for path in files) <= MAX_SKIPS
