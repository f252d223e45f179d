"""Reading and writing `.hyrf` files: the container (bytes, sections, checks) and the codec of a HybridModel.

`describe_file` needs no torch. The names that need torch are imported at their first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hyrfpack.format.info import FileReport, SectionSize, describe_file
from hyrfpack.format.run_folder import RunStatus, find_model, read_run_status

if TYPE_CHECKING:
    from hyrfpack.format.codec import decode_model, encode_model, load_model, repack, save_model
    from hyrfpack.format.parts import load_merged_model

__all__ = [
    "FileReport",
    "RunStatus",
    "SectionSize",
    "decode_model",
    "describe_file",
    "encode_model",
    "find_model",
    "load_merged_model",
    "load_model",
    "read_run_status",
    "repack",
    "save_model",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    module = "parts" if name == "load_merged_model" else "codec"
    return getattr(import_module(f"hyrfpack.format.{module}"), name)
