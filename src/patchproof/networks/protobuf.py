"""A protobuf message as plain tables, of the fields that a schema names.

In: bytes, from anyone. Out: names, numbers and views of the bytes, or UnsupportedNetwork. Messages lie in each other
as deep as the schema does and no deeper, all fields are counted before they are kept, and bytes are not copied:
Google's own reader makes 810 MB of a hostile file of 10 MB. What the schema does not name is passed over.

Source: protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from patchproof.networks.bounds import UnsupportedNetwork

MAX_FIELDS = 1 << 19  # in a file: Swin's, which computes all its sizes, has 57 thousand
MAX_ITEMS = 1 << 15  # of one kind in a message
MAX_TEXT = 1 << 16  # names are paths through modules

INT, FLOAT, TEXT, BYTES, NEVER = "int", "float", "text", "bytes", "never"
# by a field's number: its name, its kind (a schema for a message), and whether there may be several
Schema = dict[int, tuple[str, Any, bool]]


def read_message(stored: bytes, schema: Schema) -> dict[str, Any]:
    """The fields of a message by their names; a list where there may be several, absent where there is none."""
    return _MessageReader().message(memoryview(stored), schema)


class _MessageReader:
    """How many fields have been met."""

    def __init__(self):
        self.count = 0

    def message(self, data: memoryview, schema: Schema) -> dict[str, Any]:
        table: dict[str, Any] = {}
        for number, content in self._fields(data):
            if number not in schema:
                continue
            name, kind, several = schema[number]
            if several:
                items = table.setdefault(name, [])
                items.extend(self._values(content, kind, name))
                if isinstance(kind, dict) and len(items) > MAX_ITEMS:
                    raise UnsupportedNetwork(f"more than {MAX_ITEMS} items of {name}")
            elif name in table:  # other readers join the two, or take the last
                raise UnsupportedNetwork(f"{name} twice")
            else:
                (table[name],) = self._values(content, kind, name)
        return table

    def _fields(self, data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
        """Each field's number and its content: an int, or the bytes that hold it."""
        at = 0
        while at < len(data):
            key, at = self._varint(data, at)
            wire = key & 7
            if wire == 0:
                content, at = self._varint(data, at)
            elif wire in (1, 2, 5):
                size, at = self._varint(data, at) if wire == 2 else (8 if wire == 1 else 4, at)
                content = data[at : at + size]
                if len(content) < size:
                    raise UnsupportedNetwork("a field that ends after the file does")
                at += size
            else:
                raise UnsupportedNetwork(f"a field of wire type {wire}")
            yield key >> 3, content

    def _varint(self, data: memoryview, at: int) -> tuple[int, int]:
        """A number from 0 to 2^64 - 1 and the place behind it."""
        self.count += 1
        if self.count > 2 * MAX_FIELDS:  # a field has a key and a size
            raise UnsupportedNetwork(f"more than {MAX_FIELDS} fields")
        number = 0
        for shift in range(0, 64, 7):
            byte = data[at]  # IndexError past the end
            at += 1
            number |= (byte & 127) << shift
            if byte < 128:
                return number & (1 << 64) - 1, at
        raise UnsupportedNetwork("a number of more than 64 bits")

    def _values(self, content: int | memoryview, kind: Any, name: str) -> list[Any]:
        """What a field holds; several where numbers are packed into one."""
        if isinstance(content, int):
            if kind == INT:
                return [_signed(content)]
        elif kind == INT:
            numbers, at = [], 0
            while at < len(content):
                number, at = self._varint(content, at)
                numbers.append(_signed(number))
            return numbers
        elif kind == FLOAT:
            if len(content) > 4 * MAX_ITEMS:
                raise UnsupportedNetwork(f"more than {MAX_ITEMS} {name}")
            return np.frombuffer(content, "<f4").tolist()
        elif kind == TEXT:
            if len(content) > MAX_TEXT:
                raise UnsupportedNetwork(f"{name} of more than {MAX_TEXT} bytes")
            return [str(content, "utf-8")]
        elif kind == BYTES:
            return [content]
        elif isinstance(kind, dict):
            return [self.message(content, kind)]
        raise UnsupportedNetwork(f"{name}, which is not supported" if kind == NEVER else f"{name} of another kind")


def _signed(number: int) -> int:
    return number - (1 << 64) if number >= 1 << 63 else number
