"""Where a recording comes from: versions, the class of the processor, and the files that configs name."""

from __future__ import annotations

import hashlib
import platform
from importlib import metadata
from pathlib import Path

PACKAGES = [
    "retracer",
    "eclipse-zenoh",
    "embreex",
    "llvmlite",
    "mcap",
    "msgspec",
    "numba",
    "numpy",
    "pybullet",
    "scipy",
    "torch",
]

FEATURES = ("avx", "avx2", "fma", "avx512f", "avx512_bf16", "amx_bf16", "neon", "asimd", "sve")


def versions() -> dict[str, str]:
    """Return the versions of Python and of every installed package that can change a bit."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def cpu_class() -> str:
    """Return the class of the processor: vendor, family, model and the instruction sets that change a sum."""
    try:
        text = Path("/proc/cpuinfo").read_text().split("\n\n")[0]
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in text.splitlines())}
    flags = set((fields.get("flags") or fields.get("Features") or "").split())
    known = [fields.get(key, "") for key in ("vendor_id", "cpu family", "model")]
    return " ".join(filter(None, [platform.machine(), *known, *(name for name in FEATURES if name in flags)]))


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hex."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
