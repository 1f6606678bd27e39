"""The sequences that a study names for training and test, and parts of them."""

from collections.abc import Iterator
from typing import Any, NamedTuple

from adaptune.plain_words import Key
from adaptune.sequence.part import Fractions, part_name, read_part
from adaptune.space import nearest
from adaptune.study.mistakes import Mistake

ROLES = ("training", "test")
_WHOLE = (0.0, 1.0)


class _Named(NamedTuple):
    """An entry of `training` or `test`."""

    name: str  # of the sequence that it becomes
    origin: str  # of the sequence that it is a part of, or the same
    part: Fractions

    def overlaps(self, other: "_Named") -> bool:
        shared = min(self.part[1], other.part[1]) - max(self.part[0], other.part[0])
        return self.origin == other.origin and shared > 0.0


def settle_roles(data: dict[str, Any]) -> tuple[dict[str, str], list[Mistake]]:
    """Make every part that `training` and `test` name a sequence or course of its own.

    Parameters
    ----------
    data
        The study's data, changed in place: ``{hall: 0-60%}`` in a list becomes the name
        ``hall_0-60`` of a new entry.

    Returns
    -------
    origins : dict
        Name of the sequence that each new one is a part of.
    mistakes : list of Mistake
        In the lists. Entries that are no names at all are left to the models.
    """
    mistakes: list[Mistake] = []
    origins: dict[str, str] = {}
    if not all(isinstance(data.get(kind, {}), dict) for kind in ("sequences", "courses")):
        return origins, mistakes  # the models find it
    found: dict[str, list[_Named]] = {role: [] for role in ROLES}
    for role, key, entry in _entries(data):
        try:
            named = _read(data, entry, origins)
            _check(role, named, found)
        except ValueError as error:
            mistakes.append(Mistake(key, str(error)))
            data[role][key[1]] = str(next(iter(entry), "")) if isinstance(entry, dict) else entry
            continue
        found[role].append(named)
        data[role][key[1]] = named.name
        if named.name != named.origin:
            origins[named.name] = named.origin
            _add_part(data, named)
    return origins, mistakes


def role_name(entry: Any) -> str | None:
    """Name of the sequence that an entry of `training` or `test` becomes; None if it is none."""
    if isinstance(entry, str):
        return entry
    try:
        ((name, part),) = entry.items()
        return part_name(str(name), read_part(part))
    except (AttributeError, ValueError):
        return None


def _entries(data: dict[str, Any]) -> Iterator[tuple[str, Key, Any]]:
    for role in ROLES:
        if isinstance(data.get(role), list):
            data[role] = list(data[role])
            for i, entry in enumerate(data[role]):
                if isinstance(entry, str | dict):
                    yield role, (role, i), entry


def _sections(data: dict[str, Any]) -> Iterator[tuple[str, dict[Any, Any]]]:
    for kind in ("sequences", "courses"):
        if isinstance(section := data.get(kind), dict):
            yield kind, section


def _read(data: dict[str, Any], entry: Any, origins: dict[str, str]) -> _Named:
    """The entry of a list; a ValueError says what is wrong with it."""
    known = {name: section[name] for _, section in _sections(data) for name in section}
    if isinstance(entry, dict) and len(entry) != 1:
        raise ValueError("each part is an entry of its own, as in [hall: 0-60%, town: 0-60%]")
    name = next(iter(entry)) if isinstance(entry, dict) else entry
    if name not in known or name in origins:
        whole = [str(other) for other in known if other not in origins]
        raise ValueError(f"there is no sequence {name!r}: {nearest(str(name), whole)}")
    if isinstance(entry, str):
        return _Named(name, name, _WHOLE)
    try:
        part = read_part(entry[name])
    except ValueError as error:
        raise ValueError(f"{entry[name]} of {name} is no part: {error}") from error
    named = _Named(part_name(name, part), name, part)
    if isinstance(known[name], dict) and known[name].get("part") is not None:
        raise ValueError(f"{name} is a part already; name it without one")
    if named.name in known and origins.get(named.name) != name:
        raise ValueError(f"there is another sequence {named.name}; rename that one")
    return named


def _check(role: str, named: _Named, found: dict[str, list[_Named]]) -> None:
    """A ValueError says that the same was named before."""
    name = named.origin
    split = f"to split it, write training: [{name}: 0-60%], test: [{name}: 60-100%]"
    if named in found[role]:
        raise ValueError(f"{named.name!r} is named twice")
    if role == "training":
        for other in filter(named.overlaps, found[role]):
            raise ValueError(f"{named.name} overlaps {other.name}; name parts that share no scan")
        return
    for other in found["training"]:
        if named == other:
            raise ValueError(f"{name!r} is a training sequence, and proves nothing here; {split}")
        if named.overlaps(other):
            raise ValueError(
                f"{named.name} overlaps {other.name} of training, and proves nothing here; {split}"
            )


def _add_part(data: dict[str, Any], named: _Named) -> None:
    for kind, section in _sections(data):
        if isinstance(entry := section.get(named.origin), dict):
            of = {"of": named.origin} if kind == "courses" else {}
            data[kind] = section | {named.name: entry | of | {"part": list(named.part)}}
