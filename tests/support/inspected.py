"""What tests look for in an inspected recording."""

from typing import Any

from pydantic import TypeAdapter
from rich.console import Console

from adaptune import files
from adaptune.recording import SequenceConfig
from adaptune.recording.inspect import Inspection, render_inspection


def inspection_text(inspection: Any, width: int = 100) -> str:
    console = Console(width=width, color_system=None, force_terminal=False)
    with console.capture() as capture:
        console.print(render_inspection(inspection))
    return capture.get()


def entry(inspection: Any) -> dict[str, SequenceConfig]:
    """The proposed entry, read back as a study would."""
    data = files.Document(inspection.entry).data["sequences"]
    return TypeAdapter(dict[str, SequenceConfig]).validate_python(data)


def texts(inspection: Inspection) -> list[str]:
    return [fault.text for fault in inspection.faults]
