"""Which bags a path, a folder or a pattern names."""

from collections.abc import Sequence
from pathlib import Path

from adaptune.sequence.sequence import SequenceError

SUFFIXES = (".bag", ".mcap", ".db3")


def bag_paths(given: Sequence[str]) -> list[Path]:
    """Bags to open for the paths, folders and patterns that a user gives.

    A SequenceError names what does not exist or holds no bag.
    """
    paths: list[Path] = []
    for text in given:
        path = Path(text)
        if path.is_dir():
            paths += _in_folder(path)
        elif path.exists():
            if path.suffix not in SUFFIXES:
                bags = "bags are .bag, .mcap and .db3 files and ROS 2 folders"
                raise SequenceError(f"{path}: not a bag; {bags}")
            paths.append(path)
        elif found := sorted(path.parent.glob(path.name)):
            paths += bag_paths([str(match) for match in found])
        else:
            raise SequenceError(f"{path}: there is no such bag")
    if len({path.suffix == ".bag" for path in paths}) > 1:
        raise SequenceError(f"{paths[0]} and {paths[-1]} are of ROS 1 and ROS 2: they do not mix")
    return paths


def files_of(paths: Sequence[Path]) -> list[Path]:
    """The files of bags, of which some may be folders."""
    found = [sorted(path.iterdir()) if path.is_dir() else [path] for path in paths]
    return [file for files in found for file in files if file.is_file()]


def _in_folder(folder: Path) -> list[Path]:
    if (folder / "metadata.yaml").exists():
        return [folder]
    # A recorder that was killed leaves its files without the metadata.
    for suffix in (".mcap", ".db3", ".bag"):
        if found := sorted(folder.glob(f"*{suffix}")):
            return found
    raise SequenceError(f"{folder}: neither a ROS 2 bag nor a folder with bags")
