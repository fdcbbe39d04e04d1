"""A measured camera in the words of other simulators: maps, settings and a script per simulator.

A target is a module with `export(maps, settings)`; what the other program cannot
represent is said in the text that goes with it.
"""

from evflow.camera.exports.common import Export, Settings
from evflow.camera.exports.registry import TARGETS, export_camera, write_export

__all__ = ["TARGETS", "Export", "Settings", "export_camera", "write_export"]
