"""It ships no types, and what pyright would infer of its source takes seconds."""

from typing import Any

def __getattr__(name: str) -> Any: ...
