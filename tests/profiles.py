"""Text of shipped profiles, for tests that give one other parts."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]


def virtual_without_lines() -> str:
    """The virtual lab without its timing box."""
    text = (ROOT / "hardware_profiles" / "virtual.yaml").read_text("utf-8")
    return re.sub(r"(?ms)^lines:.*?(?=^\S)", "", text)
