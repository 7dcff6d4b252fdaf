"""Which files the kernels are made of: what is built must be what is there."""

from __future__ import annotations

import hashlib
from pathlib import Path


def source_hash(folder: Path = Path(__file__).parent) -> str:
    """Hash of everything that the library is compiled from."""
    parts = sorted([*folder.glob("*.h"), *folder.glob("*.cpp")])
    return hashlib.sha256(b"".join(p.name.encode() + p.read_bytes() for p in parts)).hexdigest()[:16]
