"""Tells BLACS where the tab of the device is."""

from pathlib import Path

from labscript_devices import register_classes

FOLDER = Path(__file__).parent.name  # BLACS runs this file outside its package

register_classes("Labseq", BLACS_tab=f"user_devices.{FOLDER}.blacs_tabs.LabseqTab", runviewer_parser=None)
