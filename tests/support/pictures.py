"""What a picture shows, for tests."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from matplotlib.colors import to_rgb
from matplotlib.image import imread

MODES = ("baseline", "fixed", "adaptive", "paper")


def texts(png: Path) -> list[str]:
    """All texts of the SVG beside a PNG: titles, labels, ticks and legends."""
    root = ElementTree.parse(png.with_suffix(".svg")).getroot()
    return ["".join(e.itertext()).strip() for e in root.iter("{http://www.w3.org/2000/svg}text")]


def share_of(png: Path, colour: str, above: float = 1.0) -> float:
    """Per cent of the pixels of a picture's upper part that have a colour."""
    pixels = imread(png)
    pixels = pixels[: int(above * len(pixels)), :, :3]
    apart = np.abs(pixels - to_rgb(colour)).max(axis=-1)
    return 100.0 * float((apart < 0.01).mean())


def is_white(png: Path) -> bool:
    """Whether most of a picture, and its corners, are opaque white."""
    pixels = imread(png)
    return bool((pixels[[0, 0, -1, -1], [0, -1, 0, -1]] == 1.0).all()) and share_of(png, "w") > 50
