"""What a study has learned from since its YAML was written: `learned.yaml` in its folder."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Self

from adaptune import yaml
from adaptune.files import write_text
from adaptune.plain_words import Key
from adaptune.study.mistakes import ConfigurationError
from adaptune.study.roles import role_name

FILE = "learned.yaml"
"""Training sequences beside those that the study's YAML names."""
_KINDS = {"sequences": dict, "training": list}
_HEADER = (
    "# Drives that this study has learned from beside those of its YAML. `adaptune learn` writes "
    "it.\n# Remove a drive from both lists, and run `adaptune offline`, to forget it.\n"
)


@dataclass(frozen=True)
class LearnedDrives:
    """The drives that a study has learned from.

    Attributes
    ----------
    path : Path
        The file, which need not exist.
    text : str, optional
        Its content; None if there is no file.
    sequences : dict
        By name, entries as under `sequences` of a study.
    training : list
        Entries as under `training` of a study.
    """

    path: Path
    text: str | None
    sequences: Mapping[str, Any]
    training: list[Any]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the file of a study's folder.

        Raises
        ------
        ConfigurationError
            If it is damaged.
        """
        path = folder / FILE
        try:
            text = path.read_text(encoding="utf-8")
            data = yaml.Document(text).data or {}
        except (FileNotFoundError, NotADirectoryError):
            return cls(path, None, {}, [])
        except (OSError, UnicodeDecodeError, yaml.YamlError) as error:
            raise ConfigurationError(f"{path}: cannot be read ({error}); mend it") from error
        parts = [data.get(key) or kind() for key, kind in _KINDS.items()] if _sound(data) else []
        if not parts:
            raise ConfigurationError(
                f"{path}: needs `sequences` by name, a list `training`, and nothing else; mend it"
            )
        return cls(path, text, *parts)

    def adding(self, entry: Any, sequences: Mapping[str, Any]) -> Self:
        """With another entry of `training`, and the sequences that it needs."""
        return self._of({**self.sequences, **sequences}, [*self.training, entry])

    def without(self, name: str) -> Self:
        """Without a training sequence."""
        sequences = {key: value for key, value in self.sequences.items() if key != name}
        return self._of(sequences, [entry for entry in self.training if role_name(entry) != name])

    def _of(self, sequences: Mapping[str, Any], training: list[Any]) -> Self:
        if not sequences and not training:
            return type(self)(self.path, None, {}, [])
        data = {"sequences": dict(sequences), "training": training}
        return type(self)(self.path, _HEADER + yaml.dump(data), sequences, training)

    def write(self) -> None:
        """Bring the file to this content."""
        if self.text is None:
            self.path.unlink(missing_ok=True)
        else:
            write_text(self.path, self.text)

    def merge(self, data: dict[str, Any], study: Path) -> "Added":
        """Add the drives to a study's data, which are changed.

        A drive is no longer among the test sequences: it proves nothing there.

        Parameters
        ----------
        data
            The study's data. What is of a wrong kind is left as it is.
        study
            The study's YAML.

        Raises
        ------
        ConfigurationError
            If the YAML has another sequence of the same name.
        """
        for kind in ("sequences", "courses"):
            known = names if isinstance(names := data.get(kind), dict) else {}
            for name in self.sequences:
                if name in known:
                    raise ConfigurationError(
                        f"{self.path}, line {self.line(('sequences', name))}: sequences.{name}: "
                        f"{study} names another one, {kind}.{name}; give that one another name, "
                        f"or remove this one and its entry of `training`"
                    )
        if self.sequences and isinstance(data.get("sequences", {}), dict):
            data["sequences"] = {**data.get("sequences", {}), **self.sequences}
        training, test = data.get("training"), data.get("test")
        named = list(map(role_name, training)) if isinstance(training, list) else []
        new = [i for i, entry in enumerate(self.training) if role_name(entry) not in named]
        if isinstance(training, list):
            data["training"] = [*training, *(self.training[i] for i in new)]
        learned = set(map(role_name, self.training))
        kept = list(range(len(test))) if isinstance(test, list) else []
        if isinstance(test, list) and learned:
            kept = [i for i in kept if role_name(test[i]) not in learned]
            data["test"] = [test[i] for i in kept]
        return Added(self, len(named), new, kept)

    def line(self, key: Key) -> int | None:
        """Line of a key in the file."""
        return None if self.text is None else yaml.Document(self.text).line(key)


def _sound(data: Any) -> bool:
    if not isinstance(data, dict) or not set(data) <= set(_KINDS):
        return False
    return all(isinstance(data.get(key) or kind(), kind) for key, kind in _KINDS.items())


class Added(NamedTuple):
    """What was added to a study's data, and where it stands.

    Attributes
    ----------
    learned : LearnedDrives
        The drives.
    first : int
        Index in `training` of the first that was added.
    training : list of int
        Indices of those that were added, in the drives' own list.
    test : list of int
        Indices of the test sequences that are left, in the YAML's list.
    """

    learned: LearnedDrives
    first: int
    training: list[int]
    test: list[int]

    def place(self, key: Key) -> tuple[bool, Key]:
        """Whether a key of the merged data stands in the drives' file, and its key there."""
        kind, *rest = key or ("",)
        if not rest:
            return False, key
        at = rest[0]
        if kind == "sequences" and at in self.learned.sequences:
            return True, key
        if kind == "training" and isinstance(at, int) and at >= self.first and self.training:
            return True, (kind, self.training[at - self.first], *rest[1:])
        if kind == "test" and isinstance(at, int) and at < len(self.test):
            return False, (kind, self.test[at], *rest[1:])
        return False, key
