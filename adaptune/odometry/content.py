"""What an odometry is, by its content: versions, sources, programs."""

import ast
import os
import shutil
import sys
from contextlib import suppress
from importlib import machinery, metadata
from itertools import accumulate, product
from pathlib import Path
from typing import Any

from adaptune.odometry.registry import ENTRY_POINTS, ODOMETRIES, PACKAGES, PROGRAMS

_MODULE_SUFFIXES = machinery.all_suffixes()

Content = dict[str, str]
"""By what it is of, in words, a version or the hash of a file."""


def odometry_content(name: str, settings: Any, module: str = "") -> Content:
    """What the poses of an odometry depend on besides its name, settings and parameters.

    Nothing of the user's is imported. Shared libraries, and a program behind an address, are not
    part of it. The settings name the files of a program. `module` is the one in which a class is
    written, if another one exports it.
    """
    if name in PROGRAMS:
        return _program(settings)
    if name in ODOMETRIES:
        module = ODOMETRIES[name].partition(":")[0]
        package = PACKAGES.get(name, module.rpartition(".")[2])
        content = {f"version of {package}": package_version(package)}
        if (config := getattr(settings, "config", None)) is not None:
            content[config] = _fingerprint(Path(config))
        return content
    return python_content(name, ENTRY_POINTS, module)


def python_content(name: str, group: str, written_in: str = "") -> Content:
    """Source of a module and of those that it imports, and version of the distribution it is from.

    `name` is ``module:attribute``, or what a distribution calls it in an entry-point group. The
    source of `written_in` counts, too. See `_imported`.
    """
    versions: Content = {}
    if ":" not in name:
        for point in metadata.entry_points(group=group, name=name):
            name = point.value
            if point.dist is not None:
                versions[f"version of {point.dist.name}"] = point.dist.version
    module = name.partition(":")[0]
    file = module_file(module)
    if file is None:
        return versions
    if not versions and "site-packages" in file.parts:
        # This takes half a second.
        for package in metadata.packages_distributions().get(module.partition(".")[0], ()):
            versions[f"version of {package}"] = package_version(package)
    files = {module: file} | {m: f for m in [written_in] if m and (f := module_file(m))}
    for name, path in dict(files).items():
        root = path.parents[name.count(".") + (path.stem == "__init__")]
        files |= {os.path.relpath(one, root): one for one in _imported(path, root)}
    return versions | {f"module {m}": _fingerprint(f) for m, f in files.items()}


def _imported(file: Path, folder: Path) -> list[Path]:
    """Files of what Python code imports, itself or through others, from a folder or PYTHONPATH.

    Nothing is run. What is installed is not followed: its version tells.
    """
    others = filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))
    found, folders = [file], [folder, *map(Path, others)]
    for source in found:  # which grows
        tree = ast.Module([], [])
        with suppress(ValueError, SyntaxError):  # of another Python
            tree = ast.parse(source.read_bytes() if source.suffix == ".py" else b"")
        for node in ast.walk(tree):
            level, of = getattr(node, "level", 0), getattr(node, "module", None) or ""
            names = [one.name for one in getattr(node, "names", ()) if isinstance(one, ast.alias)]
            for root, name in product([source.parents[level - 1]] if level else folders, names):
                parts = [part for part in f"{of}.{name}".split(".") if part]
                if "-packages" in str(root) or parts[0] in ("adaptune", "offline", "online"):
                    continue
                wheres = accumulate(parts, Path.joinpath, initial=root)
                files = (
                    Path(f"{w}{end}") for w in wheres for end in ("/__init__.py", *_MODULE_SUFFIXES)
                )
                found += [one for one in files if one.is_file() and one not in found]
    return found[1:]


def module_file(name: str) -> Path | None:
    """File of a module, found without importing it or what it is in; None if there is none."""
    where, origin, parts = None, None, name.split(".")
    for i in range(len(parts)):
        full = ".".join(parts[: i + 1])
        specs = (finder.find_spec(full, where) for finder in sys.meta_path)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is None:
            return None
        where, origin = spec.submodule_search_locations, spec.origin
    return Path(origin) if origin is not None and os.path.isfile(origin) else None  # noqa: PTH113


def _program(settings: Any) -> Content:
    if (image := getattr(settings, "image", None)) is not None:
        from adaptune.odometry.systems.engine import image_digest

        content = {f"image {image}": image_digest(image)}
        files: tuple[str | None, ...] = ()
    else:
        program, *arguments = settings.command or ("",)
        content, files = {}, (shutil.which(program), *arguments)
    for name in (*files, getattr(settings, "template", None)):
        # Arguments may be anything, also too long for a path.
        for file in (name or "", *(name or "").split("=", 1)[1:]):
            if os.path.isfile(file):  # noqa: PTH113
                path = Path(file).resolve()
                content[file] = _fingerprint(path)
                content |= {str(one): _fingerprint(one) for one in _imported(path, path.parent)}
    return content


def _fingerprint(file: Path) -> str:
    from adaptune.recording.cache import fingerprints  # needs what containers do not have

    return fingerprints([file])[0]


def package_version(package: str) -> str:
    """Version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "unknown"
