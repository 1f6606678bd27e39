"""What is kept of a trial in a container."""

import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from adaptune import yaml
from adaptune.files import replacing_folder
from adaptune.odometry.base import Usage
from adaptune.odometry.docker.engine import image_digest
from adaptune.space import ParameterSet


@contextmanager
def kept_log(
    logs: Path | None, settings: Any, parameters: ParameterSet, about: Mapping[str, Any]
) -> Iterator[Path | None]:
    """A folder for the block to fill, which then replaces that of the same set; None if not kept.

    Parameters
    ----------
    logs
        Folder of the sequence's logs.
    settings, parameters
        Of the trial.
    about
        What ``trial.yaml`` says besides.
    """
    if logs is None:
        yield None
        return
    whole = json.dumps([settings.model_dump(mode="json"), parameters], sort_keys=True)
    name = hashlib.blake2b(whole.encode(), digest_size=4).hexdigest()
    with replacing_folder(logs / name) as temporary:
        temporary.mkdir()
        digest = image_digest(settings.image)
        note = {"image": settings.image, "digest": digest, "parameters": parameters, **about}
        (temporary / "trial.yaml").write_text(yaml.dump(note), encoding="utf-8")
        yield temporary


def costs(usage: Usage, seconds: Mapping[str, float]) -> dict[str, Any]:
    """CPU seconds, peak megabytes and the seconds of each step, as ``trial.yaml`` has them."""
    return {
        "cpu": round(usage.cpu, 3),
        "memory": round(usage.memory or 0.0, 1),
        "seconds": {name: round(value, 2) for name, value in seconds.items()},
    }
