"""Reads YAML files into frozen, validated settings; errors name file, line and column."""

from labseq.config.addresses import ROLES, Override, profile_overrides, split_overrides
from labseq.config.document import Document, StoredText, plugin_paths
from labseq.config.find import find_profile, find_sequence
from labseq.config.profile import (
    DEVICE_KEYS,
    LINES_KEYS,
    MOTION_KEYS,
    CalibrationChoices,
    CalibrationSettings,
    MotionSettings,
    ProfileSpec,
    TimeoutSettings,
    load_profile,
)
from labseq.config.scan import Axis, Scan, bind_scan, read_scan
from labseq.config.sequence import CheckSettings, SequenceSpec, StepPolicySettings, StepSpec, load_sequence
from labseq.config.validation import validate_values
from labseq.files import packaged_profiles_dir, packaged_sequences_dir, profile_dir

__all__ = [
    "DEVICE_KEYS",
    "LINES_KEYS",
    "MOTION_KEYS",
    "ROLES",
    "Axis",
    "CalibrationChoices",
    "CalibrationSettings",
    "CheckSettings",
    "Document",
    "MotionSettings",
    "Override",
    "ProfileSpec",
    "Scan",
    "SequenceSpec",
    "StepPolicySettings",
    "StepSpec",
    "StoredText",
    "TimeoutSettings",
    "bind_scan",
    "find_profile",
    "find_sequence",
    "load_profile",
    "load_sequence",
    "packaged_profiles_dir",
    "packaged_sequences_dir",
    "plugin_paths",
    "profile_dir",
    "profile_overrides",
    "read_scan",
    "split_overrides",
    "validate_values",
]
