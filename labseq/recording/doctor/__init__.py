"""Finds what crashes, full disks and faulty ones did to recorded data, and repairs what can be repaired.

Nothing is deleted, and nothing guessed: what cannot be repaired is moved to a folder ``quarantine``
beside it, whose ``doctor.jsonl`` tells where each thing came from.
"""

from labseq.recording.doctor.findings import Finding, Report
from labseq.recording.doctor.rounds import examine

__all__ = ["Finding", "Report", "examine"]
