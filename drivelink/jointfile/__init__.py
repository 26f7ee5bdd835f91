"""Joint files: schema, hints for unknown keys, new files, changes by fit and diagnose."""

from __future__ import annotations

from drivelink.jointfile.schema import (
    MAX_BYTES,
    BusSection,
    DriveSection,
    EncoderSection,
    JointFile,
    JointText,
    LinkSection,
    MotorSection,
    RecordingSection,
    Ros2Section,
    SimSection,
    TpdoSection,
    ZenohSection,
    load,
    load_text,
    parse,
    write_model,
)

__all__ = [
    "MAX_BYTES",
    "BusSection",
    "DriveSection",
    "EncoderSection",
    "JointFile",
    "JointText",
    "LinkSection",
    "MotorSection",
    "RecordingSection",
    "Ros2Section",
    "SimSection",
    "TpdoSection",
    "ZenohSection",
    "load",
    "load_text",
    "parse",
    "write_model",
]
