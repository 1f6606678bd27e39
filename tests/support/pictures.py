"""What a picture shows, for tests."""

from pathlib import Path
from xml.etree import ElementTree


def texts(png: Path) -> list[str]:
    """All texts of the SVG beside a PNG: titles, labels, ticks and legends."""
    root = ElementTree.parse(png.with_suffix(".svg")).getroot()
    return [" ".join(e.itertext()).strip() for e in root.iter("{http://www.w3.org/2000/svg}text")]
