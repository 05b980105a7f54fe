"""How the place of an upload is written: a bucket of an object store."""

from __future__ import annotations

import re
from dataclasses import dataclass

from igtl_gateway.addon import ConfigError

_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")


@dataclass(frozen=True, slots=True)
class UploadPlace:
    """A bucket of an object store, and what keys in it begin with: no slash at either end, perhaps empty."""

    bucket: str
    prefix: str = ""

    def __str__(self) -> str:
        return f"s3://{self.bucket}/{self.prefix}".rstrip("/")


def upload_place(text: str) -> UploadPlace:
    """Parse ``s3://BUCKET/PREFIX``.  The error does not repeat what may have a key in it."""
    expected = "expected s3://BUCKET or s3://BUCKET/PREFIX; keys come from the environment or from ~/.aws"
    scheme, colon, rest = text.partition("://")
    if any(sign in text for sign in "@?#%\\") or not text.isprintable():
        raise ConfigError(f"found a URL with @, ?, #, % or a control character, {expected}")
    bucket, _, prefix = rest.partition("/")
    prefix = prefix.strip("/")
    if scheme != "s3" or not colon or not _BUCKET.fullmatch(bucket):
        raise ConfigError(f"found {text!r}, {expected}")
    if any(part in ("", ".", "..") for part in prefix.split("/") if prefix) or len(prefix.encode()) > 700:
        raise ConfigError(f"found the prefix {prefix[:80]!r}, expected names with / between them, up to 700 bytes")
    return UploadPlace(bucket, prefix)
