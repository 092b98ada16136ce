"""YAML to frozen, validated specs, with errors that name file, line and column."""

from labseq.config.addresses import Override, profile_overrides, split_overrides
from labseq.config.collect import Collected
from labseq.config.document import Document
from labseq.config.fields import Choice, plugin_paths
from labseq.config.find import find_profile, packaged_profiles_dir
from labseq.config.nodes import Loc
from labseq.config.profile import (
    MOTION_KEYS,
    ROLES,
    MotionSettings,
    ProfileSpec,
    TimeoutSettings,
    load_profile,
)
from labseq.config.sequence import SequenceSpec, StepSpec, load_sequence
from labseq.config.settings import Settings
from labseq.config.steps import (
    DeviceSettings,
    ImageSettings,
    LoadSettings,
    RearrangeSettings,
    WaitSettings,
)
from labseq.config.values import validate_values

__all__ = [
    "MOTION_KEYS",
    "ROLES",
    "Choice",
    "Collected",
    "DeviceSettings",
    "Document",
    "ImageSettings",
    "LoadSettings",
    "Loc",
    "MotionSettings",
    "Override",
    "ProfileSpec",
    "RearrangeSettings",
    "SequenceSpec",
    "Settings",
    "StepSpec",
    "TimeoutSettings",
    "WaitSettings",
    "find_profile",
    "load_profile",
    "load_sequence",
    "packaged_profiles_dir",
    "plugin_paths",
    "profile_overrides",
    "split_overrides",
    "validate_values",
]
