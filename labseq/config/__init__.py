"""YAML to frozen, validated specs, with errors that name file, line and column."""

from labseq.config.addresses import Override, profile_overrides, split_overrides
from labseq.config.calibrations import CalibrationChoices, CalibrationSettings
from labseq.config.collect import ProblemCollector
from labseq.config.devices import DEVICE_KEYS
from labseq.config.document import Document, StoredText
from labseq.config.fields import ROLES, Choice, plugin_paths
from labseq.config.find import find_profile, find_sequence
from labseq.config.lines import LINES_KEYS
from labseq.config.motion import MOTION_KEYS, MotionSettings
from labseq.config.nodes import Loc
from labseq.config.policies import CheckSettings, StepPolicySettings
from labseq.config.profile import ProfileSpec, load_profile
from labseq.config.scan import Axis, Scan
from labseq.config.scan_reading import bind_scan, read_scan
from labseq.config.sequence import SequenceSpec, StepSpec, load_sequence
from labseq.config.settings import Settings
from labseq.config.steps import (
    CheckOverlaySettings,
    CheckSitesSettings,
    DeviceSettings,
    EqualiseSettings,
    ImageSettings,
    LoadSettings,
    ProbeSettings,
    RampSettings,
    RearrangeSettings,
    WaitSettings,
)
from labseq.config.timeouts import TimeoutSettings
from labseq.config.values import validate_values
from labseq.places import profile_dir, packaged_profiles_dir, packaged_sequences_dir

__all__ = [
    "DEVICE_KEYS",
    "LINES_KEYS",
    "MOTION_KEYS",
    "ROLES",
    "Axis",
    "CalibrationChoices",
    "CalibrationSettings",
    "CheckOverlaySettings",
    "CheckSettings",
    "CheckSitesSettings",
    "Choice",
    "ProblemCollector",
    "DeviceSettings",
    "Document",
    "EqualiseSettings",
    "ImageSettings",
    "StoredText",
    "LoadSettings",
    "Loc",
    "MotionSettings",
    "Override",
    "ProbeSettings",
    "ProfileSpec",
    "RampSettings",
    "RearrangeSettings",
    "Scan",
    "SequenceSpec",
    "Settings",
    "StepPolicySettings",
    "StepSpec",
    "TimeoutSettings",
    "WaitSettings",
    "bind_scan",
    "find_profile",
    "find_sequence",
    "profile_dir",
    "load_profile",
    "load_sequence",
    "packaged_profiles_dir",
    "packaged_sequences_dir",
    "plugin_paths",
    "profile_overrides",
    "read_scan",
    "split_overrides",
    "validate_values",
]
