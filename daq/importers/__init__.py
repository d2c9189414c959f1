"""Recordings made elsewhere, brought into the run store: campaign folders and single files."""

from daq.importers.folder import import_folder
from daq.importers.open import open_campaign
from daq.importers.recording import Recording, read_recording
from daq.importers.single import RecordingOptions, import_recordings

__all__ = [
    "Recording",
    "RecordingOptions",
    "import_folder",
    "import_recordings",
    "open_campaign",
    "read_recording",
]
