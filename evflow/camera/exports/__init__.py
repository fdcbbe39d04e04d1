"""A measured camera as the settings of other simulators: maps, settings and a script for each.

A target is a module with `export(maps, settings)`; its text says what the other program cannot
represent.
"""

from evflow.camera.exports.common import Export, Settings
from evflow.camera.exports.registry import TARGETS, export_camera, write_export

__all__ = ["TARGETS", "Export", "Settings", "export_camera", "write_export"]
