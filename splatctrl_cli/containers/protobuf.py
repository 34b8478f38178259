"""Protobuf messages read by the FileDescriptorSet that a log carries, without the library or generated code.

The wire format and the field numbers of descriptors are those of protobuf.dev ("Encoding") and
google/protobuf/descriptor.proto.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

MAX_DEPTH = 32
_REPEATED, _STRING, _MESSAGE, _BYTES = 3, 9, 11, 12
_FIXED = {1: "<d", 2: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}  # struct formats by field type
_SIGNED, _ZIGZAG, _BOOL = {3, 5}, {17, 18}, 8


@dataclass(frozen=True, kw_only=True)
class _Field:
    name: str
    kind: int
    is_repeated: bool
    type_name: str


class MessageTypes:
    """The message types of one FileDescriptorSet. Raises ValueError where the bytes are none."""

    def __init__(self, descriptor_set: bytes) -> None:
        self._types: dict[str, dict[int, _Field]] = {}
        for number, file in _entries(memoryview(descriptor_set)):
            if number == 1:
                package = _text(_first(file, 2))
                for number_in_file, message in _entries(file):
                    if number_in_file == 4:
                        self._add(message, package, 0)

    def read(self, type_name: str, data: bytes) -> SimpleNamespace:
        """A message as an object with every field of its type, those not written at their defaults.

        Byte strings are views of `data`. Raises ValueError where it does not decode.
        """
        if type_name not in self._types:
            raise ValueError(f"the schema does not define {type_name}")
        return self._read(type_name, memoryview(data), 0)

    def _add(self, message: memoryview, scope: str, depth: int) -> None:
        if depth > MAX_DEPTH:
            raise ValueError("types nested too deep")
        name = ".".join(part for part in (scope, _text(_first(message, 1))) if part)
        fields = self._types.setdefault(name, {})
        for number, content in _entries(message):
            if number == 2:
                fields[_number(content, 3)] = _Field(
                    name=_text(_first(content, 1)),
                    kind=_number(content, 5),
                    is_repeated=_number(content, 4) == _REPEATED,
                    type_name=_text(_first(content, 6)),
                )
            elif number == 3:
                self._add(content, name, depth + 1)

    def _read(self, type_name: str, data: memoryview, depth: int) -> SimpleNamespace:
        fields = self._types.get(type_name)
        if fields is None or depth > MAX_DEPTH:
            raise ValueError(f"{type_name}: not defined, or nested too deep")
        result = SimpleNamespace(**{f.name: [] if f.is_repeated else None for f in fields.values()})
        for number, wire, content in _fields(data):
            field = fields.get(number)
            if field is None:
                continue
            for value in self._values(type_name, field, wire, content, depth):
                if field.is_repeated:
                    getattr(result, field.name).append(value)
                else:
                    setattr(result, field.name, value)
        for field in fields.values():
            if getattr(result, field.name) is None:
                setattr(result, field.name, self._default(type_name, field, depth))
        return result

    def _values(self, scope: str, field: _Field, wire: int, content: Any, depth: int) -> list[Any]:
        if field.kind == _MESSAGE:
            return [self._read(self._resolved(scope, field.type_name), _bytes(content), depth + 1)]
        if field.kind == _STRING:
            return [_text(_bytes(content))]
        if field.kind == _BYTES:
            return [_bytes(content)]
        if wire == 2:  # packed
            return _packed(field.kind, content)
        return [_scalar(field.kind, content)]

    def _resolved(self, scope: str, name: str) -> str:
        """The full name of a type: from a dot on as it is, else sought in the scope and those around it."""
        if name.startswith("."):
            return name[1:]
        parts = scope.split(".")
        candidates = (".".join([*parts[:count], name]) for count in range(len(parts), -1, -1))
        return next((candidate for candidate in candidates if candidate in self._types), name)

    def _default(self, scope: str, field: _Field, depth: int) -> Any:
        if field.kind == _MESSAGE:
            return self._read(self._resolved(scope, field.type_name), memoryview(b""), depth + 1)
        return {_STRING: "", _BYTES: memoryview(b"")}.get(field.kind, 0)


def _fields(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Number, wire type and content of each field: an int, or the bytes of a fixed or delimited one."""
    position = 0
    while position < len(data):
        key, position = _varint(data, position)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, position = _varint(data, position)
            yield number, wire, value
            continue
        if wire == 2:
            length, position = _varint(data, position)
        elif wire in {1, 5}:
            length = 8 if wire == 1 else 4
        else:
            raise ValueError(f"protobuf: wire type {wire}")
        if position + length > len(data):
            raise ValueError(f"protobuf: field {number} of {length} bytes, of which {len(data) - position} are there")
        yield number, wire, data[position : position + length]
        position += length


def _entries(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """The delimited fields."""
    return ((number, content) for number, wire, content in _fields(data) if wire == 2)


def _first(data: memoryview, number: int) -> memoryview:
    return next((content for found, content in _entries(data) if found == number), memoryview(b""))


def _number(data: memoryview, number: int) -> int:
    return next((content for found, wire, content in _fields(data) if found == number and wire == 0), 0)


def _varint(data: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(data):
            raise ValueError("protobuf: cut within a number")
        byte = data[position]
        position += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value & (1 << 64) - 1, position
    raise ValueError("protobuf: a number of more than 64 bits")


def _scalar(kind: int, content: Any) -> Any:
    if kind in _FIXED:
        data = _bytes(content)
        if len(data) != struct.calcsize(_FIXED[kind]):
            raise ValueError(f"protobuf: a fixed field of {len(data)} bytes")
        return struct.unpack(_FIXED[kind], data)[0]
    if not isinstance(content, int):
        raise ValueError("protobuf: expected a number, got bytes")
    if kind in _SIGNED:
        return content - (1 << 64) if content >> 63 else content
    if kind in _ZIGZAG:
        return (content >> 1) ^ -(content & 1)
    return bool(content) if kind == _BOOL else content


def _packed(kind: int, data: memoryview) -> list[Any]:
    if kind in _FIXED:
        size = struct.calcsize(_FIXED[kind])
        if len(data) % size:
            raise ValueError(f"protobuf: {len(data)} bytes of packed numbers of {size}")
        return [value for (value,) in struct.iter_unpack(_FIXED[kind], data)]
    values, position = [], 0
    while position < len(data):
        value, position = _varint(data, position)
        values.append(_scalar(kind, value))
    return values


def _bytes(content: Any) -> memoryview:
    if not isinstance(content, memoryview):
        raise ValueError("protobuf: expected bytes, got a number")
    return content


def _text(data: memoryview) -> str:
    return bytes(data).decode("utf-8")
