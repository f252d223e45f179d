"""Read facts from the machine code of a kernel for NVIDIA GPUs, with the disassembler that comes with Triton."""

from __future__ import annotations

import re
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import triton

NVDISASM_PATH = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "nvdisasm"
_INSTRUCTION = re.compile(r"^\s*/\*[0-9a-f]+\*/\s+(.*?)\s*;")
_LABEL = re.compile(r"^(\.L\w+):")
_BRANCH = re.compile(r"\bBRA\b.*`\((\.L\w+)\)")
# Arithmetic, comparisons and conversions of float64, and the guesses that its divisions and roots begin with.
_FLOAT64 = re.compile(r"\bD(ADD|MUL|FMA|SETP|MNMX)\b|\.F64\b|\bMUFU\.\w*64H\b")
# Additions to memory without a result. On sm_90 one may add two or four float32.
_ADDITION = re.compile(r"\bREDG?\.\S*\bADD\.F32(x[24])?\b")


@dataclass(frozen=True)
class SassFacts:
    """Facts about the machine code of a kernel.

    Attributes:
        loop_instructions: number of instructions of the longest loop; 0 without a loop.
        scalar_adds: number of instructions that add one float32 to memory.
        vector_adds: number of instructions that add several.
        float64: number of instructions on float64, of which consumer GPUs compute few at a time.
    """

    loop_instructions: int
    scalar_adds: int
    vector_adds: int
    float64: int


def has_disassembler() -> bool:
    """Return whether this Triton comes with the disassembler."""
    return NVDISASM_PATH.is_file()


def read_facts(cubin: bytes) -> SassFacts:
    """Return the facts of a compiled kernel."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        command = [NVDISASM_PATH, "--print-code", file.name]
        return parse_listing(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


def parse_listing(listing: str) -> SassFacts:
    """Return the facts of a kernel from the disassembler's output.

    A loop is what lies between a label and a later branch to it.
    """
    starts: dict[str, int] = {}
    longest = count = float64 = 0
    widths = []
    for line in listing.splitlines():
        if label := _LABEL.match(line):
            starts[label[1]] = count
        if not (instruction := _INSTRUCTION.match(line)):
            continue
        count += 1
        float64 += _FLOAT64.search(instruction[1]) is not None
        if (branch := _BRANCH.search(instruction[1])) and branch[1] in starts:
            longest = max(longest, count - starts[branch[1]])
        if addition := _ADDITION.search(instruction[1]):
            widths.append(addition[1])
    vectors = len(widths) - widths.count(None)
    longest = longest if longest > 1 else 0  # Code ends with a jump to itself.
    return SassFacts(longest, widths.count(None), vectors, float64)
