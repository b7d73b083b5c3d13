# SPDX-License-Identifier: Apache-2.0
"""Size and hash of files."""

import hashlib
from pathlib import Path
from typing import Annotated

from pydantic import ConfigDict, Field

from sasgeo_bench.config import Document


class FileRecord(Document):
    """Size and SHA-256 of one file."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=False)

    sha256: str
    bytes: Annotated[int, Field(ge=0)]


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal, read in pieces."""
    with path.open("rb") as source:
        return hashlib.file_digest(source, "sha256").hexdigest()


def file_record(path: Path) -> FileRecord:
    """Return size and hash of a file."""
    return FileRecord(sha256=sha256_of(path), bytes=path.stat().st_size)
