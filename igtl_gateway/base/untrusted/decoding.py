"""Decodes messages of ROS types that a file defines, within the limits, with code generated from checked definitions.

rosbags generates fourteen functions for each type.  Here each function is generated at its first use, so that reading
generates one.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, ClassVar, cast

from rosbags.interfaces import Msgdef, Nodetype
from rosbags.serde import SerdeError, cdr, ros1
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from igtl_gateway.base.errors import DamagedRecording
from igtl_gateway.base.untrusted import definitions, limits
from igtl_gateway.base.untrusted.definition_checks import Types, weight
from igtl_gateway.base.untrusted.elements import ElementCounter

_ZSTD = b"\x28\xb5\x2f\xfd"
_ENCAPSULATION = 4
_WIDE = frozenset({"int64", "uint64", "float64"})
#: Bytes that are not of the type.
BadBytes = SerdeError


def new_store(base: Stores = Stores.EMPTY) -> Typestore:
    """Return a store for the types of one file, which generates code at its first use."""
    known, store = get_typestore(base), _Store()
    store.fielddefs.update(known.fielddefs)
    store.types.update(known.types)
    return store


def register_types(store: Typestore, types: Types) -> None:
    """Register parsed types.  Raises DamagedRecording for a type that the store already has with other fields."""
    limits.check_limit("fields", sum(map(weight, types.values())), "definitions of a file")
    try:
        store.register(dict(types))
    except (TypesysError, SyntaxError, ValueError, TypeError, NameError, RecursionError) as error:
        raise DamagedRecording(f"definition of {next(iter(types), '')}: {error}") from None


class _Store(Typestore):
    """A store that generates the functions of a type when they are called; that of rosbags generates all at once."""

    def __init__(self) -> None:
        super().__init__()
        self._wide: dict[str, bool] = {}

    def get_msgdef(self, typename: str) -> Any:
        if typename not in self.cache:
            self.cache[typename] = cast("Msgdef[object]", _Code(self, typename))
        return self.cache[typename]

    def deserialize_cdr(self, rawdata: bytes | memoryview, typename: str) -> object:
        """Decode a message, also one with bytes behind it that it does not have.  Raises SerdeError.

        Fast DDS counts the alignment of empty sequences of 64-bit numbers: up to four bytes for each, of any value.
        """
        try:
            return super().deserialize_cdr(rawdata, typename)
        except SerdeError as error:
            if len(rawdata) <= _ENCAPSULATION or not self._has_wide_sequence(typename):
                raise
            code = self.get_msgdef(typename)
            read = code.deserialize_cdr_le if rawdata[1] else code.deserialize_cdr_be
            body = rawdata[_ENCAPSULATION:]
            try:
                message, end = read(body, 0, code.cls, self)
            except (struct.error, UnicodeDecodeError, ValueError):
                raise error from None
            if len(body) - end > end:
                raise
            return cast("object", message)

    def _has_wide_sequence(self, typename: str) -> bool:
        """Whether a message can have a sequence of 64-bit numbers."""
        if typename not in self._wide:
            self._wide[typename] = any(
                (kind in (Nodetype.SEQUENCE, Nodetype.ARRAY) and self._is_wide(inner[0], kind))
                or (kind == Nodetype.NAME and self._has_wide_sequence(cast("str", inner)))
                for _, (kind, inner) in self.fielddefs[typename][1]
            )
        return self._wide[typename]

    def _is_wide(self, element: Any, kind: Nodetype) -> bool:
        if element[0] == Nodetype.NAME:
            return self._has_wide_sequence(element[1])
        return kind == Nodetype.SEQUENCE and element[1][0] in _WIDE


class _Code:
    """The attributes of ``Msgdef`` of rosbags, generated one by one."""

    _MAKERS: ClassVar[dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]] = {
        "serialize_cdr_le": (cdr.generate_serialize_cdr, ("le",)),
        "serialize_cdr_be": (cdr.generate_serialize_cdr, ("be",)),
        "deserialize_cdr_le": (cdr.generate_deserialize_cdr, ("le",)),
        "deserialize_cdr_be": (cdr.generate_deserialize_cdr, ("be",)),
        "serialize_ros1": (ros1.generate_serialize_ros1, ()),
        "deserialize_ros1": (ros1.generate_deserialize_ros1, ()),
    }
    _PAIRS: ClassVar[dict[str, tuple[Callable[..., Any], int]]] = {
        "getsize_cdr": (cdr.generate_getsize_cdr, 0),
        "size_cdr": (cdr.generate_getsize_cdr, 1),
        "getsize_ros1": (ros1.generate_getsize_ros1, 0),
        "size_ros1": (ros1.generate_getsize_ros1, 1),
    }
    _CONVERTERS: ClassVar[dict[str, tuple[Callable[..., Any], bool]]] = {
        "getsize_ros1_to_cdr": (ros1.generate_ros1_to_cdr, False),
        "ros1_to_cdr": (ros1.generate_ros1_to_cdr, True),
    }

    def __init__(self, store: Typestore, name: str) -> None:
        self.name = name
        self.fields = [(normalize_fieldname(field), description) for field, description in store.fielddefs[name][1]]
        self.cls = store.types[name]
        self._store = store

    def __getattr__(self, attribute: str) -> Any:
        if attribute in self._MAKERS:
            make, arguments = self._MAKERS[attribute]
            made = make(self.fields, self._store, *arguments)
        elif attribute in self._PAIRS:
            make, place = self._PAIRS[attribute]
            made = make(self.fields, self._store)[place]
        elif attribute in self._CONVERTERS:
            make, copies = self._CONVERTERS[attribute]
            made = make(self.fields, self.name, self._store, copy=copies)
        else:
            raise AttributeError(attribute)
        setattr(self, attribute, made)
        return made


class MessageDecoder:
    """Decodes messages of types that a file defines, each type with its own definition.

    Code is generated at the first message of a type.
    """

    def __init__(self, definition_of: Callable[[str], str]) -> None:
        self._definition_of = definition_of
        self._stores: dict[str, tuple[Typestore, ElementCounter] | DamagedRecording] = {}
        self._fields = 0

    def store(self, ros_type: str) -> Typestore:
        """Return the store with the type.  Raises DamagedRecording."""
        return self._find_store(ros_type)[0]

    def decode(self, ros_type: str, data: bytes) -> Any:
        """Decode a message.  Raises DamagedRecording; SerdeError for bytes that are not of the type."""
        store, elements = self._find_store(ros_type)
        if data[: len(_ZSTD)] == _ZSTD:  # no CDR begins so
            raise SerdeError(
                "found a message that is compressed with zstd, expected CDR; `igtl-gateway import` unpacks it"
            )
        elements.check(data)
        return store.deserialize_cdr(data, ros_type)

    def _find_store(self, ros_type: str) -> tuple[Typestore, ElementCounter]:
        if ros_type not in self._stores:
            try:
                self._stores[ros_type] = self._load(ros_type)
            except DamagedRecording as error:
                self._stores[ros_type] = error
        found = self._stores[ros_type]
        if isinstance(found, DamagedRecording):
            # without its traceback: it grows with each raise and would keep all frames, and so all messages, in memory
            raise found.with_traceback(None)
        return found

    def _load(self, ros_type: str) -> tuple[Typestore, ElementCounter]:
        text = self._definition_of(ros_type)
        if not text:
            raise DamagedRecording(f"{ros_type}: found no definition")
        types = definitions.parse_definition(text, ros_type)
        self._fields += sum(map(weight, types.values()))
        limits.check_limit("fields", self._fields, "definitions of a file", 2 * limits.current_limits().fields)
        store = new_store()
        register_types(store, types)
        return store, ElementCounter(types, ros_type)
