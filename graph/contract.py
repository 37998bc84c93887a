"""What an operator is: a typed Config, typed Outputs, and one on_<port> method for each input."""

from __future__ import annotations

import inspect
import types
import typing
from collections.abc import Iterator
from typing import Any, Literal

import msgspec


class ContractError(TypeError):
    """A class that is not an operator as the runtime understands it."""


class End(msgspec.Struct, frozen=True):
    """Returned or yielded by an on_ method: this was the last; ends the run where the graph says `end: OPERATOR`."""

    reason: str = ""


class Summary(dict[str, Any]):
    """What an operator says at the end: name to number, or name to a dict of numbers."""


class Operator:
    """A deterministic state machine: messages in, messages out; no clock, no socket, no unseeded random number.

    `on_<port>(message)` returns None, one Outputs, End, or an iterator of them. Ports are handled in the order of the
    class body, base classes first. `on_start` runs at the first stamp, `on_end` once at the end. A method annotated
    `-> None` never says anything, so nobody waits for what it might have said.
    """

    class Config(msgspec.Struct):
        """No settings."""

    class Outputs(msgspec.Struct):
        """No outputs."""

    config: Any
    stamp: int = 0  # of the present call, nanoseconds of logical time: when its message arrived; set by the runtime

    def __init__(self, config: Any = None) -> None:
        self.config = type(self).Config() if config is None else config

    @classmethod
    def warm_up(cls) -> None:
        """Run on made-up data what has to be compiled; called before the operator is constructed."""

    @classmethod
    def missing(cls, config: Any, wired: frozenset[str]) -> str:
        """Return what `check` warns of: an input without which this configuration does less than it says; "" if none.

        wired: the inputs that the graph feeds.
        """
        return ""

    def on_start(self) -> Any:
        return None

    def on_end(self) -> Any:
        return None


class Source(Operator):
    """An operator without inputs that may touch the world, and is never run again by a replay."""

    def stream(self) -> Iterator[tuple[int, Any]]:
        """Yield (stamp in nanoseconds, Outputs); stamps increase strictly."""
        raise NotImplementedError


class Sink(Operator):
    """An operator without outputs that takes the latest of each input and holds back nobody."""


RESERVED: tuple[str, ...] = ("start", "end")


class Ports(msgspec.Struct, frozen=True):
    """Inputs and outputs of an operator class, in the order of its body: port to message type."""

    inputs: dict[str, type[msgspec.Struct]]
    outputs: dict[str, type[msgspec.Struct]]
    silent: frozenset[str] = frozenset()  # inputs whose methods are annotated `-> None`


def _message_type(hint: Any, where: str) -> type[msgspec.Struct]:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not types.NoneType]
        hint = kinds[0] if len(kinds) == 1 else hint
    if not (isinstance(hint, type) and issubclass(hint, msgspec.Struct)):
        raise ContractError(f"{where} wants one message type (a msgspec.Struct); it is annotated {hint!r}")
    return hint


_ports: dict[type[Operator], Ports] = {}


def ports_of(kind: type[Operator]) -> Ports:
    """Read the ports of an operator class from its methods and its Outputs, once. Raises ContractError by name."""
    if kind not in _ports:
        _ports[kind] = _read_ports(kind)
    return _ports[kind]


def method_hints(kind: type[Operator], method: str) -> dict[str, Any]:
    """Read the annotations of a method; names of the class body, such as Outputs, count as known."""
    return typing.get_type_hints(getattr(kind, method), localns=dict(vars(kind)))


def _read_ports(kind: type[Operator]) -> Ports:
    name = kind.__qualname__
    inputs: dict[str, type[msgspec.Struct]] = {}
    silent: set[str] = set()
    for base in reversed(kind.__mro__):
        for attribute, method in vars(base).items():
            port = attribute.removeprefix("on_")
            if port == attribute or port in RESERVED or not inspect.isfunction(method):
                continue
            try:
                hints = method_hints(kind, attribute)
            except NameError as error:
                raise ContractError(f"{name}.{attribute}: {error}") from error
            parameters = list(inspect.signature(getattr(kind, attribute)).parameters)[1:]
            if len(parameters) != 1 or parameters[0] not in hints:
                raise ContractError(f"{name}.{attribute} wants exactly one annotated parameter, the message")
            inputs[port] = _message_type(hints[parameters[0]], f"{name}.{attribute}")
            if hints.get("return") is types.NoneType:
                silent.add(port)
    try:
        hints = typing.get_type_hints(kind.Outputs)
    except NameError as error:
        raise ContractError(f"{name}.Outputs: {error}") from error
    outputs = {
        field: _message_type(hints[field], f"{name}.Outputs.{field}") for field in kind.Outputs.__struct_fields__
    }
    return Ports(inputs, outputs, frozenset(silent))


def kind_of(kind: type[Operator]) -> Literal["operator", "source", "sink"]:
    """Say whether a class is a source, a sink or a plain operator."""
    if issubclass(kind, Source):
        return "source"
    return "sink" if issubclass(kind, Sink) else "operator"
