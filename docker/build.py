"""Build the project's images: `python docker/build.py reference`, `reference-ros2` or `adaptune`.

A build downloads nothing through pip: wheels for the Python of Debian 12 come from a folder that
is filled here first. adaptune's own wheel comes last, so that a change of it builds one layer.
"""

import argparse
import hashlib
import logging
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import docker
import requests
from docker.errors import DockerException

ROOT = Path(__file__).resolve().parents[1]
BASE = "debian:bookworm-slim"
PYTHON = "3.11"
"""Of the base."""
GLIBC = 36
"""Of the base: 2.36."""
ROS2 = "reference-ros2"
FOLDERS = {name: ROOT / "docker" / name for name in ("reference", ROS2)}
FOLDERS["adaptune"] = ROOT / "docker"
"""Where an image's Dockerfile is."""
FILES = {"reference": ["rustle-ros"], ROS2: ["params.yaml"], "adaptune": []}
"""Files and folders beside it that go into the image."""
TAGS = {"reference": "adaptune-reference", ROS2: "adaptune-reference-ros2", "adaptune": "adaptune"}
NODE = FOLDERS[ROS2] / "node"
"""A program in Rust, which is built here: that of Debian 12 is too old for what it needs."""
RUST = "1.88"
REFERENCE_NEEDS = ("numpy", "pydantic", "scipy", "small_gicp", "typing-extensions")
"""What `adaptune.odometry.keyframe` and `adaptune.odometry.registry` import, sooner or later."""
SOURCES = ("adaptune", "offline", "online", "pyproject.toml", "README.md", "LICENSE")
SOURCE_DATE = "1700000000"
"""The same sources make the same wheel, to the byte."""

_log = logging.getLogger("docker/build.py")


class BuildError(Exception):
    """An image that cannot be built."""


class LackingError(BuildError):
    """What `make services` installs is not there."""


def engine() -> docker.DockerClient:
    """The Docker engine; a `LackingError` that says what to do if none answers."""
    try:
        client = docker.from_env()
        client.ping()
    except (DockerException, requests.RequestException) as error:
        what = "no Docker engine answers: run `make services`, or set DOCKER_HOST"
        raise LackingError(f"{what} ({error})") from error
    return client


def build(name: str, tag: str | None = None) -> str:
    """Build an image and return its tag; where nothing changed, that takes a few seconds."""
    tag = tag or TAGS[name]
    with closing(engine()) as client:
        make_base(client)
        context = _context(name)
        _build(client, context, tag)
    return tag


def _build(client: docker.DockerClient, context: Path, tag: str) -> None:
    said = []
    for answer in client.api.build(path=str(context), tag=tag, rm=True, forcerm=True, decode=True):
        if "error" in answer:
            raise BuildError(f"{tag} cannot be built:\n{''.join(said[-30:])}{answer['error']}")
        said.append(answer.get("stream", ""))
        if said[-1].startswith("Step "):
            _log.info("%s", said[-1].rstrip())
        else:
            _log.debug("%s", said[-1].rstrip())


def make_base(client: docker.DockerClient) -> None:
    """Pull the base image, or make it with debootstrap where no registry answers."""
    if client.images.list(BASE):
        return
    try:
        _log.info("pulling %s", BASE)
        client.images.pull(BASE)
    except (DockerException, requests.RequestException) as error:
        _log.warning("cannot pull %s (%s): making it with debootstrap", BASE, error)
        _bootstrap(client)


def _bootstrap(client: docker.DockerClient) -> None:
    if shutil.which("debootstrap") is None:
        raise LackingError(f"{BASE} is missing, and so is debootstrap: run `make services`")
    sudo = [] if os.geteuid() == 0 else ["sudo"]
    folder = tempfile.mkdtemp(prefix="adaptune-base-")
    try:
        _run(*sudo, "debootstrap", "--variant=minbase", "bookworm", folder)
        left_out = [f"--exclude=./var/{it}/*" for it in ("cache/apt", "lib/apt/lists", "log")]
        tar = [*sudo, "tar", "-C", folder, *left_out, "-c", "."]
        with subprocess.Popen(tar, stdout=subprocess.PIPE) as archive:
            repository, _, tag = BASE.partition(":")
            client.api.import_image_from_stream(
                archive.stdout, repository=repository, tag=tag, changes=['CMD ["bash"]']
            )
        if archive.returncode or not client.images.list(BASE):
            raise BuildError(f"what debootstrap made cannot be imported as {BASE}")
    finally:
        _run(*sudo, "rm", "-rf", "--one-file-system", folder)


def _context(name: str) -> Path:
    """Gather what a build sees: the Dockerfile and its folders, wheels, and adaptune's wheel."""
    context = ROOT / "build/docker" / name
    context.mkdir(parents=True, exist_ok=True)
    shutil.copy(FOLDERS[name] / "Dockerfile", context)
    for file in FILES[name]:
        shutil.rmtree(context / file, ignore_errors=True)
        _copy(FOLDERS[name] / file, context / file)
    if name == ROS2:
        (context / "bin").mkdir(exist_ok=True)
        shutil.copy(build_node(), context / "bin")
        return context
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    needed = REFERENCE_NEEDS if name == "reference" else project["dependencies"]
    _download(context / "wheels", needed)
    _own_wheel(context / "adaptune")
    return context


def build_node() -> Path:
    """Build the ROS 2 node, and return the program; a `LackingError` if there is no Rust.

    What it is made of is kept for other copies of the project: the first time takes five minutes.
    """
    if shutil.which("cargo") is None:
        raise LackingError(f"there is no cargo: install Rust {RUST} or newer by rustup")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    target = cache / "adaptune-reference-ros2"
    manifest = f"--manifest-path={NODE / 'Cargo.toml'}"
    _log.info("building %s", NODE)
    _run("cargo", "build", "--release", "--locked", "--quiet", manifest, f"--target-dir={target}")
    return target / "release/adaptune-reference-ros2"


def _download(folder: Path, requirements: Iterable[str]) -> None:
    """Fill a folder with wheels for the base, unless it holds them."""
    constraints = ROOT / "constraints.txt"
    machine = platform.machine()
    digest = _digest([constraints], BASE, machine, *requirements)
    if _is_made(folder, digest):
        return
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in range(GLIBC, 16, -1)]
    platforms.append(f"manylinux2014_{machine}")
    _run(
        *(sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check"),
        *("--only-binary=:all:", "--implementation=cp", f"--python-version={PYTHON}"),
        *(f"--platform={it}" for it in platforms),
        *(f"--dest={folder}", f"--constraint={constraints}", *requirements),
    )
    _stamp(folder).write_text(digest)


def _stamp(folder: Path) -> Path:
    return folder.with_suffix(".made")


def _is_made(folder: Path, digest: str) -> bool:
    """Whether a folder holds the wheels that a digest stands for; if not, it is removed."""
    stamp = _stamp(folder)
    if stamp.exists() and stamp.read_text() == digest and any(folder.glob("*.whl")):
        return True
    stamp.unlink(missing_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    return False


def _own_wheel(folder: Path) -> None:
    """Make adaptune's wheel in a folder, unless it holds that of these sources."""
    with tempfile.TemporaryDirectory() as made:
        sources = Path(made)
        for name in SOURCES:
            _copy(ROOT / name, sources / name)
        files = sorted(path for path in sources.rglob("*") if path.is_file())
        digest = _digest(files, *(str(path.relative_to(sources)) for path in files))
        if _is_made(folder, digest):
            return
        _run(
            *(sys.executable, "-m", "pip", "wheel", "--quiet", "--disable-pip-version-check"),
            *("--no-deps", f"--wheel-dir={folder}", made),
            env=os.environ | {"SOURCE_DATE_EPOCH": SOURCE_DATE},
        )
        _stamp(folder).write_text(digest)


def _copy(source: Path, target: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__"))
    else:
        shutil.copy(source, target)


def _digest(files: Iterable[Path], *texts: str) -> str:
    found = hashlib.sha256("\n".join(texts).encode())
    for file in files:
        found.update(file.read_bytes())
    return found.hexdigest()


def _run(*command: str, env: dict[str, str] | None = None) -> None:
    """Run a command; a `BuildError` with its last words if it fails."""
    done = subprocess.run(
        command,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if done.returncode:
        raise BuildError(f"{' '.join(command)} failed:\n{done.stdout[-2000:]}")


def main() -> None:
    """Build the image that the command line names."""
    parser = argparse.ArgumentParser(description="Build one of the project's images.")
    parser.add_argument("image", choices=sorted(FOLDERS))
    parser.add_argument("--tag", help="its name on the engine")
    parser.add_argument("--verbose", action="store_true", help="show all that the build says")
    given = parser.parse_args()
    logging.basicConfig(format="%(message)s")
    _log.setLevel(logging.DEBUG if given.verbose else logging.INFO)
    try:
        _log.info("built %s", build(given.image, given.tag))
    except BuildError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
