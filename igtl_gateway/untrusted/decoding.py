"""Messages of ROS types that a file defines: code for each is made of an examined definition, and messages are bounded.

rosbags makes fourteen functions of each type; here each is made where it is used, so that reading makes one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, cast

from rosbags.interfaces import Msgdef
from rosbags.serde import cdr, ros1
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore

from igtl_gateway.errors import DamagedRecording
from igtl_gateway.untrusted import definitions, limits
from igtl_gateway.untrusted.definition_checks import Types, weight
from igtl_gateway.untrusted.elements import ElementCounter


def new_store(base: Stores = Stores.EMPTY) -> Typestore:
    """A store for the types of one file; code to read and write messages is made where it is used."""
    known, store = get_typestore(base), _Store()
    store.fielddefs.update(known.fielddefs)
    store.types.update(known.types)
    return store


def register_types(store: Typestore, types: Types) -> None:
    """Make code of types that ``definitions.parse`` gave.  Raises DamagedRecording for what the store has otherwise."""
    limits.check_limit("fields", sum(map(weight, types.values())), "definitions of a file")
    try:
        store.register(dict(types))
    except (TypesysError, SyntaxError, ValueError, TypeError, NameError, RecursionError) as error:
        raise DamagedRecording(f"definition of {next(iter(types), '')}: {error}") from None


class _Store(Typestore):
    """rosbags makes fourteen functions of each type at once; this one makes those that are called."""

    def get_msgdef(self, typename: str) -> Any:
        if typename not in self.cache:
            self.cache[typename] = cast("Msgdef[object]", _Code(self, typename))
        return self.cache[typename]


class _Code:
    """What ``Msgdef`` of rosbags has, attribute by attribute."""

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

    Code is made at a type's first message.
    """

    def __init__(self, definition_of: Callable[[str], str]) -> None:
        self._definition_of = definition_of
        self._stores: dict[str, tuple[Typestore, ElementCounter] | DamagedRecording] = {}
        self._fields = 0

    def store(self, ros_type: str) -> Typestore:
        """The store that knows the type.  Raises DamagedRecording."""
        return self._find_store(ros_type)[0]

    def decode(self, ros_type: str, data: bytes) -> Any:
        """A message.  Raises DamagedRecording; SerdeError where the bytes are none of the type."""
        store, elements = self._find_store(ros_type)
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
            # without its traceback, which grows with each raise and keeps the frames, and so the messages, of all
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
