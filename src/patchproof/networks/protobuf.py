"""Read the fields of a protobuf message that a schema names, into plain dictionaries.

In: untrusted bytes. Out: names, numbers and views of the bytes, or UnsupportedNetwork. Messages are nested as deep as
the schema and no deeper, all fields are counted before they are kept, and bytes are not copied: Google's own reader
makes 810 MB of a hostile file of 10 MB. A field that the schema does not name is refused, since it may mean anything.

Source: protobuf.dev/programming-guides/encoding.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from patchproof.networks.bounds import UnsupportedNetwork

MAX_FIELDS = 1 << 19  # in a file; Swin's, which computes all its sizes, has 57 thousand
MAX_ITEMS = 1 << 15  # of one kind in a message
MAX_TEXT = 1 << 16  # bytes of a name, which is a path through modules

INT, FLOAT, TEXT, BYTES, UNSUPPORTED, SKIPPED = "int", "float", "text", "bytes", "never", "skipped"
# by a field's number: its name, its kind (a schema for a message), and whether it may be repeated
Schema = dict[int, tuple[str, Any, bool]]


def read_schemas(text: str) -> dict[str, Schema]:
    """Schemas by name from "NAME: NUMBERS FIELD KIND; ...." A * behind a kind, one of those above or an earlier
    message, marks repeated fields. Skipped fields change nothing: names, comments, exporters' versions.
    """
    schemas: dict[str, Schema] = {}
    for message in text.strip().split(".")[:-1]:
        message_name, _, fields = message.partition(":")
        schema = schemas[message_name.strip()] = {}
        for field in fields.split(";"):
            numbers, *name, kind = field.split()
            plain = kind.removesuffix("*")
            entry = " ".join(name), schemas.get(plain, plain), plain != kind
            schema |= {int(number): entry for number in numbers.split(",")}
    return schemas


class MessageReader:
    """Reads nested messages and counts the fields of all of them."""

    def __init__(self):
        self.count = 0

    def message(self, data: memoryview, schema: Schema) -> dict[str, Any]:
        """The fields of a message by name; repeated fields are lists, absent fields have no entry."""
        table: dict[str, Any] = {}
        for number, content in self._fields(data):
            if number not in schema:
                raise UnsupportedNetwork(f"a field of the unknown number {number}")
            name, kind, repeated = schema[number]
            if kind == SKIPPED:
                continue
            if repeated:
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
        """Yield each field's number and its content: an int, or the bytes that hold it."""
        position = 0
        while position < len(data):
            key, position = self._varint(data, position)
            wire = key & 7
            if wire == 0:
                content, position = self._varint(data, position)
            elif wire in (1, 2, 5):
                size, position = self._varint(data, position) if wire == 2 else (8 if wire == 1 else 4, position)
                content = data[position : position + size]
                if len(content) < size:
                    raise UnsupportedNetwork("a field that ends after the file does")
                position += size
            else:
                raise UnsupportedNetwork(f"a field of wire type {wire}")
            yield key >> 3, content

    def _varint(self, data: memoryview, position: int) -> tuple[int, int]:
        """A number from 0 to 2^64 - 1 and the position behind it."""
        self.count += 1
        if self.count > 2 * MAX_FIELDS:  # a field has a key and a size
            raise UnsupportedNetwork(f"more than {MAX_FIELDS} fields")
        number = 0
        for shift in range(0, 64, 7):
            byte = data[position]  # IndexError past the end
            position += 1
            number |= (byte & 127) << shift
            if byte < 128:
                return number & (1 << 64) - 1, position
        raise UnsupportedNetwork("a number of more than 64 bits")

    def _values(self, content: int | memoryview, kind: Any, name: str) -> list[Any]:
        """The values in a field; several where numbers are packed into one."""
        if isinstance(content, int):
            if kind == INT:
                return [_signed(content)]
        elif kind == INT:
            numbers, position = [], 0
            while position < len(content):
                number, position = self._varint(content, position)
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
        reason = f"{name}, which is not supported" if kind == UNSUPPORTED else f"{name} of an unexpected wire type"
        raise UnsupportedNetwork(reason)


def _signed(number: int) -> int:
    return number - (1 << 64) if number >= 1 << 63 else number
