"""The registers of the card, their values and the error codes, under the vendor's names.

They come from the vendor's package ``spcm_core``, which cannot be imported without a driver library, but its
two files of constants can.
"""

from __future__ import annotations

from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from typing import TYPE_CHECKING, Final

ERR_OK: Final = 0x0
SPCM_BUF_DATA: Final = 1000
SPCM_DIR_PCTOCARD: Final = 0
TYPE_DOUBLE: Final = 1
"""Kind and direction of a transfer, and type of an entry of a register list, in the driver's C interface."""


def _constants() -> dict[str, int]:
    package = find_spec("spcm_core")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("No module named 'spcm_core'", name="spcm_core")
    constants: dict[str, int] = {}
    for name in ("regs", "spcerr"):
        spec = spec_from_file_location(f"{__name__}_{name}", Path(package.origin).with_name(f"{name}.py"))
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
        constants |= {key: value for key, value in vars(module).items() if isinstance(value, int)}
    return constants


_found: Final = _constants()
globals().update(_found)

if TYPE_CHECKING:

    def __getattr__(name: str) -> int: ...


NAMES: Final = {
    value: name
    for name, value in _found.items()
    if name.startswith("SPC_") and not name.startswith(("SPC_TM", "SPC_CM_", "SPC_REP_"))
}
"""Register number -> name, for error messages."""
