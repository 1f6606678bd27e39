"""YAML with the numbers and booleans of YAML 1.2, unique keys, and line numbers."""

import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import yaml

from adaptune.errors import AdaptuneError


class YamlError(AdaptuneError):
    """Text that is not YAML, or gives a key twice."""


YamlPath = tuple[str | int, ...]
"""The keys and indices that lead to a part of a document."""
_TAGS = ("null", "bool", "int", "float", "str", "seq", "map")


class _Loader(yaml.SafeLoader):
    """Numbers and booleans of YAML 1.2: 1e3 is a number, 010 is ten, `on` is a string.

    Nothing but plain data is made: no dates, no bytes, no sets. Keys stay as they are written.
    """

    yaml_constructors = {  # noqa: RUF012 - that is how PyYAML keeps them
        tag: constructor
        for tag, constructor in yaml.SafeLoader.yaml_constructors.items()
        if tag is None or tag.rpartition(":")[2] in _TAGS
    }

    yaml_implicit_resolvers = {  # noqa: RUF012 - that is how PyYAML keeps them
        first: [(tag, regexp) for tag, regexp in resolvers if tag.rpartition(":")[2] == "null"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; refuse a key that comes twice."""
        seen: dict[str, int] = {}
        for key_node, _ in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                raise YamlError(f"line {line}: a key must be a word or a number")
            key = _str(self, key_node)
            if key in seen:
                raise YamlError(f"line {line}: {key!r} was given before, in line {seen[key]}")
            seen[key] = line
        values = [self.construct_object(value, deep) for _, value in node.value]
        return dict(zip(seen, values, strict=True))


_PREFIX = "tag:yaml.org,2002:"
_INT = re.compile(r"^[-+]?[0-9]+$")
_FLOAT = re.compile(
    r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_BOOL = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_Loader.add_implicit_resolver(_PREFIX + "int", _INT, list("-+0123456789"))
_Loader.add_implicit_resolver(_PREFIX + "float", _FLOAT, list("-+0123456789."))
_Loader.add_implicit_resolver(_PREFIX + "bool", _BOOL, list("tTfF"))


_NO_CHARACTER = re.compile("[\0\ud800-\udfff]")
_MOST_VALUES = 100_000
"""Values in a document. Aliases of aliases make more out of a few lines than fit in memory."""


def _int(loader: Any, node: Any) -> int:
    return int(loader.construct_scalar(node))  # PyYAML takes 010 for eight


def _str(loader: Any, node: Any) -> str:
    text: str = loader.construct_scalar(node)
    if _NO_CHARACTER.search(text):
        line = node.start_mark.line + 1
        raise YamlError(f"line {line}: a text holds a null character or half of one; remove it")
    return text


_Loader.add_constructor(_PREFIX + "int", _int)
_Loader.add_constructor(_PREFIX + "str", _str)


def _count(node: Any, counted: dict[int, int]) -> int:
    """Number of values in a node, with those that aliases repeat."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in counted:
        counted[id(node)] = _MOST_VALUES  # if met again in itself
        parts = node.value
        if isinstance(node, yaml.MappingNode):
            parts = [part for pair in parts for part in pair]
        counted[id(node)] = 1 + sum(_count(part, counted) for part in parts)
    return counted[id(node)]


class _Foreign(yaml.SafeLoader):
    """What ROS 1 reads: YAML 1.1, where 1e3 is a text. Keys stay as they are written."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping."""
        self.flatten_mapping(node)
        return {str(key.value): self.construct_object(value, deep) for key, value in node.value}


# Tags of other tools, as !!opencv-matrix, say nothing of what is below them.
_plain: Any = lambda loader, node: getattr(loader, f"construct_{node.id}")(node)  # noqa: E731
_Foreign.add_constructor(None, _plain)


class Document:
    """A YAML text as plain data (`data`), and where in the text each part of it stands.

    A YamlError names the line that is wrong.
    """

    def __init__(self, text: str, foreign: bool = False):
        self.text = text
        if foreign:
            # OpenCV begins files so, which no YAML does; all places in the text stay.
            text = re.sub(r"\A(\ufeff?)%YAML:", r"\1#YAML:", text)
        try:
            loader = _Foreign(text) if foreign else _Loader(text)
            self._node = loader.get_single_node()
            if self._node is not None and _count(self._node, {}) > _MOST_VALUES:
                raise YamlError(f"holds more than {_MOST_VALUES:,} values, or an alias of itself")
            self.again = [*_again(self._node)] if foreign else []  # before keys are merged
            self.data = None if self._node is None else loader.construct_document(self._node)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            where = f"line {mark.line + 1}: " if mark else ""
            what = ", ".join(part for part in (error.context, error.problem) if part)
            raise YamlError(f"{where}{what}") from error
        except RecursionError as error:
            raise YamlError("is nested too deeply") from error
        except yaml.YAMLError as error:
            raise YamlError(" ".join(str(error).split())) from error
        except (ValueError, LookupError, AttributeError) as error:
            # PyYAML's constructors raise these.
            what = "a tag (!!...) does not fit its value, or a number has thousands of digits"
            raise YamlError(f"{what}; leave tags out, and give a smaller one") from error

    @classmethod
    def of_file(cls, path: Path) -> Self:
        """Read a file; a YamlError that names it if it cannot be read."""
        try:
            return cls(path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            raise YamlError(f"{path}: there is no such file") from error
        except (OSError, UnicodeDecodeError) as error:
            raise YamlError(f"{path}: cannot be read as text ({error})") from error
        except YamlError as error:
            raise YamlError(f"{path}: {error}") from error

    def span(self, path: Sequence[str | int]) -> tuple[int, int] | None:
        """Where in the text a single value begins and ends; None if there is none."""
        nodes = self._along(path)
        node = nodes[-1][1] if nodes else self._node
        if len(nodes) < len(path) or not isinstance(node, yaml.ScalarNode):
            return None
        return node.start_mark.index, node.end_mark.index

    def name(self, path: Sequence[str | int]) -> str:
        """The single value at a path as it is written: a name, also where it is a number."""
        return str(self._along(path)[-1][1].value)

    def line(self, path: Sequence[str | int]) -> int | None:
        """Line of the deepest part of `path` that is there; none for an empty document."""
        nodes = self._along(path)
        return nodes[-1][0].start_mark.line + 1 if nodes else None

    def _along(self, path: Sequence[str | int]) -> list[tuple[Any, Any]]:
        """The nodes of the keys on a path, as far as they are there, and of their values."""
        node, found = self._node, list[tuple[Any, Any]]()
        for part in path:
            entries: list[tuple[Any, Any]] = []
            if isinstance(node, yaml.MappingNode):
                entries = [entry for entry in node.value if entry[0].value == str(part)]
            elif isinstance(node, yaml.SequenceNode) and isinstance(part, int):
                entries = [(value, value) for value in node.value[part : part + 1]]
            if not entries:
                break
            found.append(entries[-1])
            node = entries[-1][1]
        return found

    def with_added(self, path: Sequence[str | int], added: Any) -> str:
        """The text with more entries in the mapping or list at a path, or with another value there.

        Nothing else in it changes.
        """
        nodes, text = self._along(path), self.text
        if len(nodes) < len(path):
            return self.with_added(path[:-1], {path[-1]: added})
        node: Any = nodes[-1][1] if nodes else self._node
        begin, end = node.start_mark.index, node.end_mark.index
        flow = yaml.dump(added, None, _Dumper, default_flow_style=True, width=2**31).split("\n")[0]
        if isinstance(node, yaml.ScalarNode) or not node.value:
            return f"{text[:begin]}{' ' * (text[begin - 1] == ':')}{flow}{text[end:]}"
        mapping = isinstance(node, yaml.MappingNode)
        first, last = (node.value[i][i] if mapping else node.value[i] for i in (0, -1))
        if node.flow_style:
            return f"{text[: last.end_mark.index]}, {flow[1:-1]}{text[last.end_mark.index :]}"
        lines = text[:end].split("\n")
        while lines[-1].strip()[:1] in ("", "#"):
            lines.pop()  # what stands above the next key
        before = "\n".join(lines)
        line = text.split("\n")[first.start_mark.line]
        indent = line[: len(line) - len(line.lstrip())]
        return f"{before}\n{textwrap.indent(dump(added), indent)}{text[len(before) + 1 :]}"

    def where(self, file: Path, path: Sequence[str | int]) -> str:
        """The file of this text, and the line of `path` in it."""
        line = self.line(path)
        return f"{file}, line {line}" if line else str(file)


def _keys(node: Any, path: YamlPath = ()) -> Iterator[tuple[YamlPath, Any, Any]]:
    """The keys of all mappings in a node, with their paths and the nodes of both."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            there = (*path, str(key.value))
            yield there, key, value
            yield from _keys(value, there)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            yield from _keys(value, (*path, i))


def _again(root: Any) -> Iterator[tuple[str, int, int]]:
    """The keys that come again in a mapping, with their lines, and those of the first ones."""
    first: dict[YamlPath, Any] = {}
    for path, key, _ in _keys(root):
        if first.setdefault(path, key) is not key and key.tag != _PREFIX + "merge":
            lines = (one.start_mark.line + 1 for one in (key, first[path]))
            yield ".".join(map(str, path)), *lines


class _Dumper(yaml.SafeDumper):
    """Quotes what YAML 1.1 or 1.2 does not read back as a string, and repeats lists."""

    def ignore_aliases(self, data: Any) -> bool:  # noqa: ARG002
        """Write everything out."""
        return True

    def represent_str(self, data: str) -> Any:
        """Quote a text; an AdaptuneError if a study cannot hold it."""
        if _NO_CHARACTER.search(data):
            raise AdaptuneError(f"{data!a}: holds what is no character in UTF-8; rename it")
        # As a plain text, PyYAML folds rarer line breaks, and does not read them back.
        style = '"' if re.search("[\x85\u2028\u2029]", data) else None
        return self.represent_scalar(_PREFIX + "str", data, style)


_Dumper.add_representer(str, _Dumper.represent_str)
for _tag, _regexp, _first in (("int", _INT, "-+0123456789"), ("float", _FLOAT, "-+0123456789.")):
    _Dumper.add_implicit_resolver(_PREFIX + _tag, _regexp, list(_first))


def dump(data: Any, comments: Mapping[YamlPath, str] | None = None) -> str:
    """Plain data as YAML that is read back as just these, keys in their order.

    Comments stand above the keys at their paths; those of keys that are not there are left out. An
    AdaptuneError names a text that YAML cannot hold.
    """
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100)
    if not comments:
        return text
    lines = text.split("\n")
    for path, key, _ in reversed([*_keys(Document(text)._node)]):
        comment, indent = comments.get(path, ""), " " * key.start_mark.column
        lines[key.start_mark.line : key.start_mark.line] = [
            f"{indent}# {line}" for line in comment.splitlines()
        ]
    return "\n".join(lines)
