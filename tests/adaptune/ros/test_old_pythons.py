"""What a robot's Python runs must be written for 2.7 and 3.6; the tests have neither.

The parser knows the grammar of 3.6; of 2.7 there is a list of what came later.
"""

import ast
import builtins
from pathlib import Path

from adaptune.ros import ros1_node

LATER = (
    *(ast.AnnAssign, ast.AsyncFor, ast.AsyncFunctionDef, ast.AsyncWith, ast.Await, ast.JoinedStr),
    *(ast.MatMult, ast.NamedExpr, ast.Nonlocal, ast.YieldFrom),
)
STATEMENTS = {"exec", "print"}
"""Of Python 2, where no attribute can be called so."""
ERRORS = {
    name
    for name, of in vars(builtins).items()
    if isinstance(of, type) and issubclass(of, OSError) and of is not OSError
} | {"ModuleNotFoundError", "RecursionError"}
"""Names that only Python 3 has."""


def later(source):
    """What Python 2.7 or 3.6 cannot read in a source, as lines and words."""
    try:
        tree = ast.parse(source, feature_version=(3, 6))
    except SyntaxError as error:
        return [(error.lineno, "not of Python 3.6")]
    lines = enumerate(source.splitlines(), 1)
    found = [(number, "not ASCII") for number, line in lines if not line.isascii()]
    for node in ast.walk(tree):
        what = [type(node).__name__] if isinstance(node, LATER) else []
        what += [words for words, has in OF_NODE.items() if has(node)]
        found += [(getattr(node, "lineno", 0), words) for words in what]
    return found


OF_NODE = {
    "an annotation": lambda n: getattr(n, "annotation", None) or getattr(n, "returns", None),
    "an argument by keyword only": lambda n: getattr(n, "kwonlyargs", None),
    "raise from": lambda n: isinstance(n, ast.Raise) and n.cause,
    "** in a mapping": lambda n: isinstance(n, ast.Dict) and None in n.keys,
    "super without arguments": lambda n: (
        isinstance(n, ast.Call) and getattr(n.func, "id", None) == "super" and not n.args
    ),
    "a statement's name": lambda n: isinstance(n, ast.Attribute) and n.attr in STATEMENTS,
    "a name of Python 3": lambda n: isinstance(n, ast.Name) and n.id in STATEMENTS | ERRORS,
}
"""What a part of a source may have that came later, and that its type alone does not tell."""


def test_old_pythons_can_read_it():
    assert later(Path(ros1_node.__file__).read_text(encoding="utf-8")) == []
