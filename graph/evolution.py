"""Messages of another time: a recorded schema against today's, by name of the field."""

from __future__ import annotations

import json
from typing import Any

from graph.codec import schema, type_name
from graph.recording import Recording, RecordingError


def _fields(text: str) -> dict[str, tuple[dict[str, Any], set[str]]]:
    """Read {struct: ({field: schema}, required fields)} out of a JSON Schema."""
    return {
        name: (body.get("properties", {}), set(body.get("required", [])))
        for name, body in json.loads(text).get("$defs", {}).items()
    }


def mismatch(recorded: str, current: str) -> str | None:
    """Say which field of a recorded schema does not fit the current one; None if it can be read.

    Fields with defaults may have been added on either side; nothing else may differ.
    """
    then, now = _fields(recorded), _fields(current)
    for name, (old, old_required) in then.items():
        if name not in now:
            return f"{name} is not known any more"
        new, new_required = now[name]
        for field, kind in old.items():
            if field not in new:
                if field in old_required:
                    return f"{name}.{field} is in the recording and not in this version"
                continue
            if _bare(kind) != _bare(new[field]):
                return f"{name}.{field} was {_described(kind)} and is {_described(new[field])} now"
        for field in new:
            if field not in old and field in new_required:
                return f"{name}.{field} is not in the recording, and has no default"
    return None


def _bare(kind: Any) -> Any:
    """Drop what is said for people only."""
    if isinstance(kind, dict):
        return {key: _bare(value) for key, value in kind.items() if key not in ("description", "title", "default")}
    return [_bare(item) for item in kind] if isinstance(kind, list) else kind


def _described(kind: dict[str, Any]) -> str:
    if "anyOf" in kind:
        return " or ".join(_described(item) for item in kind["anyOf"])
    if "x-dtype" in kind:
        return f"{kind['x-dtype']} {tuple(kind['x-shape'])} {kind.get('x-unit', '')}".rstrip()
    name = str(kind.get("type") or kind.get("$ref", "").rpartition("/")[2] or "any")
    return f"{name} {kind['x-unit']}" if "x-unit" in kind else name


def require_schema(recording: Recording, topic: str, kind: type[Any]) -> None:
    """Raise RecordingError, naming the field, if a recorded topic cannot be read as a message type."""
    name, text = recording.types[topic]
    if name != type_name(kind):
        raise RecordingError(f"{recording.path}: {topic} holds {name}; {type_name(kind)} is wanted")
    try:
        reason = mismatch(text, schema(kind))
    except (ValueError, AttributeError, TypeError) as error:
        raise RecordingError(f"{recording.path}: the schema of {topic} cannot be read: {error}") from error
    if reason is not None:
        raise RecordingError(f"{recording.path}: {topic} is of another version of {kind.__name__}: {reason}")
