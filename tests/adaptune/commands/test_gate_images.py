"""Two images of the same odometry: is the new one worse?"""

import json
from pathlib import Path

import commands
import drives
import pytest
from needs import reference_image

from adaptune.odometry.systems.engine import engine

pytestmark = pytest.mark.services

SLIP = "sed -i -E 's/^([^ ]+) ([^ ]+)/\\1 \\2e-1/' /output/*"
"""Moves a tenth of the way along x."""


@pytest.fixture
def images():
    """The reference with its command, as it is and with a slip."""
    image, made = reference_image(), []
    plain = "odometry-plain $ADAPTUNE_POINTS"
    for tag, script in {"old": plain, "new": f"{plain} && {SLIP}"}.items():
        container = engine().containers.create(image)
        command = json.dumps(["sh", "-c", script])
        container.commit("adaptune-gate", tag, changes=f"CMD {command}")
        container.remove()
        made.append(f"adaptune-gate:{tag}")
    yield made
    for tag in made:
        engine().images.remove(tag, force=True)


def test_an_image_with_a_slip_is_worse(images, tmp_path, monkeypatch):
    old, new = images
    monkeypatch.chdir(tmp_path)
    bags = ("drive_a.bag", "drive_b.bag")
    for seed, bag in enumerate(bags):
        drives.write_bag(Path(bag), drives.scans(seed, 150))
    done = commands.call("compare", new, *bags, "--against", old, "--out", "out")
    assert done.exit_code == 3, done.output
    rows = json.loads(Path("out/verdict.json").read_text())["rows"]
    errors = {row["recording"]: row["ratio"] for row in rows if row["quantity"] == "error"}
    assert all(ratio > 2.0 for ratio in errors.values())
    # A whole run has one figure of its cost, which differs each time.
    costs = [row for row in rows if row["quantity"] == "cost"]
    assert {row["verdict"] for row in costs} == {"unclear"}
