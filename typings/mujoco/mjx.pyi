# Its data classes are too dynamic for a type checker.
from typing import Any

def __getattr__(name: str) -> Any: ...
