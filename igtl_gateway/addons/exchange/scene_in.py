"""Import of scenes of 3D Slicer (``.mrb``, ``.mrml``): poses, pictures, points and strings become messages of a peer.

A scene has sequences, and nodes that do not change.  Each becomes a stream of OpenIGTLink that is named as its node:
transforms TRANSFORM, volumes IMAGE, markups POINT, lines TRAJ, text nodes STRING; what else has data is named.  The
index of an item is its time, in seconds from the start time, which is ``epoch_ns``, or what a scene of our own states.

A bundle is a zip of others: nothing is unpacked that its head does not bound, no name leads out of it, and every file
is checked when it is needed.  Memory: the document, and one item of each stream.
"""

from __future__ import annotations

import heapq
import lzma
import math
import re
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from igtl_gateway.addon import NS_PER_S, DamagedRecording, GatewayError, UnsupportedRecording, distinct_names
from igtl_gateway.addon.igtl import DEVICE_NAME_AT, Body, Message, String, Transform, cut_text, encode, ns_to_ticks
from igtl_gateway.addon.reading import join
from igtl_gateway.addon.terminal import count_text, counted
from igtl_gateway.addon.untrusted import Element, files, limits, parse_xml, whole_number
from igtl_gateway.addon.writing import make_folder, open_new
from igtl_gateway.addons.exchange.markups import Markup, read_markups
from igtl_gateway.addons.exchange.scene_nodes import read_facts
from igtl_gateway.addons.exchange.sequence import DEFAULT_EPOCH_NS, no_pose
from igtl_gateway.addons.exchange.sequence import Sequence as SequenceFile
from igtl_gateway.addons.exchange.slicer_file import content_of
from igtl_gateway.addons.exchange.source import (
    ImportedItem,
    ImportedStream,
    NonRosSource,
    file_begin_items,
    file_end_item,
    library_errors_as_damage,
    peer_item,
)

_LINK = 1
_ZIP_HEAD = 30  # bytes of the head of a file in a zip
_NAME = 20
_COPIED = 1 << 20
_BEGIN, _STREAM = "IgtlGateway.BeginNs", "IgtlGateway.Stream"
_ABOUT = "About this scene"
_OWN_EMPTY = "the empty one before the first"
#: Elements of nodes that become messages.
_NODES = {
    "LinearTransform": "TRANSFORM",
    "Volume": "IMAGE",
    "VectorVolume": "IMAGE",
    "MarkupsFiducial": "POINT",
    "MarkupsLine": "TRAJ",
    **dict.fromkeys((f"Markups{kind}" for kind in ("Angle", "Curve", "ClosedCurve", "Plane", "ROI")), "POINT"),
    "Text": "STRING",
}
#: What is not imported although it has data: element → its name for people.
_OTHERS = {
    "Model": "models",
    "Table": "tables",
    "Segmentation": "segmentations",
    "LabelMapVolume": "label maps",
    "Transform": "transforms that are not linear",
    "BSplineTransform": "B-spline transforms",
    "GridTransform": "grid transforms",
    "DiffusionTensorVolume": "tensor volumes",
    "DiffusionWeightedVolume": "diffusion volumes",
    "FiberBundle": "fibre bundles",
}
_MARKUPS = frozenset(tag for tag in _NODES if tag.startswith("Markups"))
#: The version that a scene states, and the newest one whose scenes are known.
_VERSION = re.compile(r"[A-Za-z- ]*([0-9]{1,4})(?:\.([0-9]{1,6}))?(?:[.-].*)?")
_NEWEST = (5, 13)
#: Times from 1970 to 2106.
_END_NS = NS_PER_S << 32


def looks_like_scene(start: bytes) -> bool:
    """Return whether the first bytes of a file are those of a bundle or of a scene."""
    return (start.startswith(b"PK\x03\x04") and len(start) > _ZIP_HEAD) or b"<MRML" in start


class _Files:
    """The files of a scene by their names beside its document."""

    def __init__(self, path: Path, where: str) -> None:
        self.where = where
        self._path = path

    def document(self) -> bytes:
        """Return the document."""
        return files.read_bytes(self._path)

    def find(self, name: str) -> Path:
        """Return a file that the document names.  Raises DamagedRecording or UnsupportedRecording."""
        parts = _checked(name, self.where).parts
        folder = self._path.parent
        found = folder.joinpath(*parts)
        try:
            is_outside = not found.resolve().is_relative_to(folder.resolve())
        except (OSError, RuntimeError):
            is_outside = True
        if is_outside:
            raise DamagedRecording(
                f"{self.where}: found a reference to {name[:80]!r}, a link out of the folder, expected a file below it"
            )
        if not found.exists():
            raise DamagedRecording(
                f"{self.where}: found no {name[:80]!r} beside the scene, expected the file of a node"
            )
        files.size_of(found)
        return found

    def close(self) -> None:
        """Close the files."""


class Bundle(_Files):
    """A zip, whose files are unpacked one by one into a folder of their own."""

    def __init__(self, path: Path, where: str) -> None:
        super().__init__(path, where)
        self._room = tempfile.TemporaryDirectory(prefix="igtl-gateway-")
        self._done: dict[str, Path] = {}
        try:
            with _zip_errors(path, where):
                self._stream = files.open_file(path)
                self._zip = zipfile.ZipFile(self._stream)
            self._infos = self._checked_infos()
            documents = [name for name in self._infos if name.lower().endswith(".mrml") and name.count("/") <= 1]
            if len(documents) != 1:
                raise UnsupportedRecording(
                    f"{where}: found {counted(len(documents), 'scene')} (.mrml) in the bundle, expected one"
                )
        except BaseException:
            self._room.cleanup()
            raise
        self._document = documents[0]

    def _checked_infos(self) -> dict[str, zipfile.ZipInfo]:
        """Return the heads of all files by name.  Raises DamagedRecording or LimitExceeded for those that lie."""
        found: dict[str, zipfile.ZipInfo] = {}
        infos = self._zip.infolist()
        limits.check_limit("count", len(infos), f"{self.where}: files in the bundle")
        for info in infos:
            if info.is_dir():
                continue
            name = str(_checked(info.filename, self.where))
            if name in found:
                raise DamagedRecording(f"{self.where}: found {name[:80]!r} twice in the bundle, expected once")
            if info.flag_bits & 1:
                raise UnsupportedRecording(f"{self.where}: {name[:80]}: found an encrypted file, expected a plain one")
            if info.compress_type != zipfile.ZIP_STORED:
                limits.check_unpacked(info.compress_size, info.file_size, f"{self.where}: {name[:80]}")
            elif info.compress_size != info.file_size:
                raise DamagedRecording(
                    f"{self.where}: {name[:80]}: found {count_text(info.file_size, 'byte')} stored in "
                    f"{info.compress_size:,}, "
                    "expected the same number"
                )
            found[name] = info
        squeezed = [info for info in found.values() if info.compress_type != zipfile.ZIP_STORED]
        bound = limits.current_limits()
        allowed = max(bound.free, bound.ratio * sum(info.compress_size for info in squeezed))
        unpacked = sum(info.file_size for info in squeezed)
        limits.check_limit("ratio", unpacked, f"{self.where}: unpacked bytes of all files", allowed)
        packed = sum(info.compress_size for info in found.values())
        if packed > files.size_of(self._path):
            raise DamagedRecording(
                f"{self.where}: found {count_text(packed, 'packed byte')} in a file of {files.size_of(self._path):,}, "
                "expected no shared ones"
            )
        return found

    def document(self) -> bytes:
        info = self._infos[self._document]
        limits.check_limit("free", info.file_size, f"{self.where}: {self._document}")
        with _zip_errors(self._path, f"{self.where}: {self._document}"), self._zip.open(info) as stream:
            return stream.read()

    def find(self, name: str) -> Path:
        folder = PurePosixPath(self._document).parent
        wanted = str(folder / _checked(name, self.where))
        info = self._infos.get(wanted)
        if info is None:
            raise DamagedRecording(f"{self.where}: found no {wanted[:80]!r} in the bundle, expected the file of a node")
        if wanted not in self._done:
            path = Path(self._room.name) / f"{len(self._done)}" / PurePosixPath(wanted).name
            make_folder(path.parent)
            self._unpack(info, path)
            self._done[wanted] = path
            if path.name.endswith(".nhdr"):
                self._unpack_pixels(path, folder / PurePosixPath(name).parent)
        return self._done[wanted]

    def _unpack(self, info: zipfile.ZipInfo, path: Path) -> None:
        deadline = files.deadline_of(self._path)
        size = 0
        where = f"{self.where}: {info.filename[:80]}"
        with _zip_errors(self._path, where), self._zip.open(info) as old, open_new(path) as new:
            while part := old.read(_COPIED):
                size += len(part)
                deadline.check(self.where)
                new.write(part)
        if size != info.file_size:
            raise DamagedRecording(f"{where}: found {count_text(size, 'byte')}, expected {info.file_size:,}")

    def _unpack_pixels(self, header: Path, folder: PurePosixPath) -> None:
        """Unpack the file that an NRRD header names beside it."""
        with header.open("rb") as stream:
            for line in stream:
                key, _, value = line.decode("utf-8", "replace").partition(":")
                if key.strip().lower().replace(" ", "") == "datafile":
                    name = value.strip().removeprefix("./")
                    info = self._infos.get(str(folder / _checked(name, self.where)))
                    if info is None or "/" in name or name == header.name:
                        raise DamagedRecording(
                            f"{self.where}: {header.name}: found {name[:80]!r} as its file of pixels, expected a file "
                            "of the bundle beside it"
                        )
                    self._unpack(info, header.parent / name)
                    return

    def close(self) -> None:
        self._zip.close()
        self._stream.close()
        self._room.cleanup()


@contextmanager
def _zip_errors(path: Path, where: str) -> Iterator[None]:
    """Context manager: errors of the libraries that read a zip name the place, and what is found and expected."""
    try:
        with library_errors_as_damage(path):
            yield
    except DamagedRecording as error:
        cause = error.__context__
        if isinstance(cause, (zipfile.BadZipFile, zlib.error, lzma.LZMAError, NotImplementedError, EOFError)):
            text = str(cause) or type(cause).__name__
            raise DamagedRecording(f"{where}: found a damaged zip ({text}), expected a whole bundle") from None
        raise


def _checked(name: str, where: str) -> PurePosixPath:
    """Return a name in a scene, below its folder.  Raises DamagedRecording for one that leads out of it."""
    path = PurePosixPath(name)
    if not name or "\\" in name or "\0" in name or ":" in name or path.is_absolute() or ".." in path.parts:
        raise DamagedRecording(
            f"{where}: found the file name {name[:80]!r}, expected one below the folder of the scene"
        )
    return path


def _document(place: _Files, read: int = 0) -> tuple[Element, int]:
    """Return the document of a scene and its size: with the ``read`` bytes of others, at most half of ``free``."""
    bound = limits.current_limits()
    data = place.document()
    allowed = bound.free // 2
    limits.check_limit("free", read + len(data), f"{place.where}: bytes of the documents", allowed)
    with limits.limits_in_force(replace(bound, document=allowed)):
        root = parse_xml(data, place.where)
    if root.name != "MRML":
        raise UnsupportedRecording(f"{place.where}: line {root.line}: found <{root.name[:40]}>, expected <MRML>")
    return root, len(data)


@dataclass(slots=True)
class _Node:
    """A node of a scene, or an item of a sequence."""

    element: Element
    refers: dict[str, str] = field(default_factory=dict)

    @property
    def id(self) -> str:
        return self.element.attributes.get("id", "")

    @property
    def name(self) -> str:
        return self.element.attributes.get("name", "")

    @property
    def facts(self) -> dict[str, str]:
        return read_facts(self.element.attributes.get("attributes", ""))


def _nodes(root: Element) -> dict[str, _Node]:
    found = {}
    for element in root.children:
        pairs = (each.partition(":") for each in element.attributes.get("references", "").split(";") if each)
        refers = {role.strip(): (target.split() or [""])[0] for role, _, target in pairs}
        # before the references there was one attribute for each kind
        refers.setdefault("storage", element.attributes.get("storageNodeRef", ""))
        node = _Node(element, refers)
        found[node.id] = node
    return found


#: Time, message and row of each item of a stream, in order of time.
_Items = Iterator[tuple[int, ImportedItem]]


class SceneSource(NonRosSource):
    """An open scene.  Raises DamagedRecording, UnsupportedRecording or LimitExceeded."""

    def __init__(self, path: Path, epoch_ns: int | None = None) -> None:
        super().__init__("", {})
        self._path = path
        with files.open_file(path) as stream:
            is_bundle = stream.read(2) == b"PK"
        self._files: _Files = Bundle(path, str(path)) if is_bundle else _Files(path, str(path))
        self._opened: list[_Files] = [self._files]
        #: Scenes in the scene, by their paths.
        self._inner: dict[Path, tuple[_Files, dict[str, _Node]]] = {}
        try:
            self._read(epoch_ns)
        except BaseException:
            self.close()
            raise

    def _read(self, epoch_ns: int | None) -> None:
        root, self._document_bytes = _document(self._files)
        self._note_version(root, self._files.where)
        nodes = self._scene = _nodes(root)
        self.title = f"scene {self._path.name}"
        browsers = [node for node in nodes.values() if node.element.name == "SequenceBrowser"]
        stated = next((text for node in browsers if (text := node.facts.get(_BEGIN))), "")
        begin_ns = whole_number(stated, _END_NS - 1) if epoch_ns is None else epoch_ns
        self._own = bool(stated)
        self.begin_ns = DEFAULT_EPOCH_NS if begin_ns is None else begin_ns
        self.facts |= {"imported_format": "scene", "sequence_epoch_ns": str(self.begin_ns)}
        moved = {}
        for browser in browsers:
            for role, target in browser.refers.items():
                if role.startswith("sequenceNodeRef"):
                    moved[target] = browser.refers.get(f"dataNodeRef{role.removeprefix('sequenceNodeRef')}", "")
        sequences = [node for node in nodes.values() if node.element.name == "Sequence"]
        still = [
            node
            for node in nodes.values()
            if node.element.name in _NODES and node.id not in moved.values() and node.name != _ABOUT
        ]
        limits.check_limit("fields", len(sequences), f"{self._path}: sequences")
        limits.check_limit("topics", len(still), f"{self._path}: nodes that no sequence moves")
        wanted = {node.id: self._device(node, nodes.get(moved.get(node.id, ""))) for node in (*sequences, *still)}
        self._devices = distinct_names(
            wanted,
            lambda name: cut_text(name, _NAME),
            other=lambda name, n: f"{cut_text(name, _NAME - len(str(n)))}{n}",
        )
        self.notes += [
            f"{wanted[node]}: the device name is {device}"
            for node, device in self._devices.items()
            if device != wanted[node]
        ]
        self.rows += [
            ImportedStream(node.name, 1, node.element.name, 0, 1, f"{what} are not imported")
            for node in nodes.values()
            if node.id not in moved.values() and (what := _OTHERS.get(node.element.name))
        ]
        self._streams = [self._sequence(node) for node in sequences] + [self._still(node) for node in still]
        if not any(row.declared > row.left_out for row in self.rows):
            found = ", ".join(dict.fromkeys(_OTHERS[row.type] for row in self.rows if row.type in _OTHERS))
            raise UnsupportedRecording(
                f"{self._path}: found {f'only {found}' if found else 'no poses, pictures, points or strings'}, "
                f"expected {'poses, pictures, points or strings' if found else 'some'}"
            )

    def _note_version(self, root: Element, where: str) -> None:
        """Add a note if the scene is of a version that this program does not know: it may miss a part of it."""
        version = root.attributes.get("version", "")
        found = _VERSION.fullmatch(version)
        if version and not (found and (int(found[1]), int(found[2] or 0)) <= _NEWEST):
            newest = ".".join(map(str, _NEWEST))
            self.notes.append(f"{where}: found the version {version[:40]!r}, known are those up to Slicer{newest}")

    def _device(self, node: _Node, shown: _Node | None) -> str:
        """Return the name of a node as that of a device: of our own scenes, that of the device."""
        stream = node.facts.get(_STREAM, "")
        side, _, channel = stream.partition(":")
        kind, _, device = channel.partition("/")
        if side in ("in", "out") and kind and device and kind == kind.upper():
            return device
        name = shown.name if shown else node.name.removesuffix("-Seq")
        return name or "Node"

    # -- streams

    def _sequence(self, node: _Node) -> _Items:
        """Return the items of a sequence; its rows are in the account."""
        device, kept = self._devices[node.id], self._scene.get(node.refers.get("storage", ""))
        name = unquote(kept.element.attributes.get("fileName", "")) if kept else ""
        row = ImportedStream(node.name, 0, "Sequence")
        self.rows.append(row)
        unit = node.element.attributes.get("indexUnit", "s") or "s"
        if node.element.attributes.get("indexType", "numeric") != "numeric" or unit != "s":
            row.declared = row.left_out = 1
            row.why = f"its index is not a time in s, but {unit[:20]}"
            return iter(())
        if not name:
            row.declared = row.left_out = 1
            row.why = "it has no file"
            return iter(())
        path = self._files.find(name)
        if name.lower().endswith((".mrb", ".mrml")):
            return self._bundle(node, row, device, path, node.element.attributes.get("indexValues", ""))
        self.rows.remove(row)
        return self._frames(path, device, self.begin_ns)

    def _frames(self, path: Path, device: str, begin_ns: int) -> _Items:
        """Return the messages of an image file or a sequence of images or poses, under the name of a node."""
        try:
            source = SequenceFile(path, begin_ns)
        except GatewayError as error:
            raise type(error)(str(error).replace(str(path), f"{self._path}: {path.name}")) from None
        source.rows = [row for row in source.rows if row.declared and not (row.type == "IMAGE" and row.why)]
        several = len([row for row in source.rows if row.type == "TRANSFORM"]) > 1
        self.rows += source.rows

        def items() -> _Items:
            before_ns = 0
            for item in source.items():
                if item.type not in ("IMAGE", "TRANSFORM"):
                    continue
                row = next(
                    row for row in source.rows if row.type == item.type and (not several or row.stream in item.channel)
                )
                if self._own and item.source_ns < before_ns:
                    row.taken -= 1
                    row.left_out += 1
                    row.why = _OWN_EMPTY
                    continue
                before_ns = max(before_ns, item.source_ns)
                yield before_ns, item if several and item.type == "TRANSFORM" else _renamed(item, device)
            self.notes += [f"{device}: {note}" for note in source.notes if note not in self.notes]

        if not several:
            for row in source.rows:
                row.stream = device
        return items()

    def _scene_in(self, path: Path) -> tuple[_Files, dict[str, _Node]]:
        """Return the files and the nodes of a scene in the scene, which several sequences may name."""
        if path not in self._inner:
            with path.open("rb") as stream:
                is_bundle = stream.read(2) == b"PK"
            where = f"{self._path}: {path.name}"
            place: _Files = Bundle(path, where) if is_bundle else _Files(path, where)
            self._opened.append(place)
            root, size = _document(place, self._document_bytes)
            self._document_bytes += size
            self._note_version(root, where)
            self._inner[path] = place, _nodes(root)
        return self._inner[path]

    def _bundle(self, node: _Node, row: ImportedStream, device: str, path: Path, values: str) -> _Items:
        """Return the items of a sequence that is a scene itself."""
        place, inner = self._scene_in(path)
        found: list[tuple[int, _Node]] = []
        used = set[str]()
        limits.check_limit("count", values.count(";"), f"{self._path}: {node.name}: indexes")
        for word in values.split(";"):
            key, colon, text = word.strip().rpartition(":")
            if not word.strip():
                continue
            item = inner.get(key)
            if not colon or item is None:
                raise DamagedRecording(
                    f"{self._path}: {node.name}: found the index {word[:60]!r}, expected NODE:SECONDS"
                )
            if key in used:
                raise DamagedRecording(f"{self._path}: {node.name}: found {key[:60]!r} at two indexes, expected one")
            used.add(key)
            found.append((self._time(text, node.name), item))
        row.declared, kinds = len(found), {item.element.name for _, item in found}
        row.type = next((_NODES.get(kind, kind) for kind in kinds), "Sequence")
        if not kinds <= {"Text", "LinearTransform", *_MARKUPS}:
            names = sorted(_OTHERS.get(kind, kind) for kind in kinds)
            row.left_out, row.why = len(found), f"{', '.join(names)} are not imported"
            return iter(())
        found.sort(key=lambda one: one[0])

        def items() -> _Items:
            for time_ns, item in found:
                message = self._message(item, inner, place, device, time_ns)
                if message is None:
                    row.left_out += 1
                    row.why = _OWN_EMPTY if self._own else "empty"
                else:
                    row.taken += 1
                    yield time_ns, message

        row.stream = device
        return items()

    def _still(self, node: _Node) -> _Items:
        """Return the one message of a node that no sequence moves."""
        device, kind = self._devices[node.id], node.element.name
        if kind in ("Volume", "VectorVolume"):
            kept = self._scene.get(node.refers.get("storage", ""))
            name = unquote(kept.element.attributes.get("fileName", "")) if kept else ""
            if not name:
                self.rows.append(ImportedStream(device, 1, "IMAGE", 0, 1, "it has no file"))
                return iter(())
            return self._frames(self._files.find(name), device, self.begin_ns)
        row = ImportedStream(device, 1, _NODES[kind])
        self.rows.append(row)

        def items() -> _Items:
            message = self._message(node, self._scene, self._files, device, self.begin_ns)
            if message is None:
                row.left_out, row.why = 1, "empty"
            else:
                row.taken = 1
                yield self.begin_ns, message

        return items()

    # -- messages

    def _message(
        self, node: _Node, scene: dict[str, _Node], place: _Files, device: str, time_ns: int
    ) -> ImportedItem | None:
        """Return the message of a node; None if it is empty."""
        content: Body
        kind = _NODES[node.element.name]
        match node.element.name:
            case "Text":
                text = node.element.attributes.get("text", "")
                if not text:
                    return None
                content = String(text.encode("utf-8", "replace"), 106)
            case "LinearTransform":
                content = self._transform(node, scene)
            case _:
                kept = scene.get(node.refers.get("storage", ""))
                name = unquote(kept.element.attributes.get("fileName", "")) if kept else ""
                if not name.lower().endswith(".json"):
                    raise UnsupportedRecording(
                        f"{place.where}: {node.name}: found the file {name[:60]!r}, expected markups (.mrk.json)"
                    )
                markup = _markup(place.find(name), f"{place.where}: {name}")
                if not markup.points:
                    return None
                kind, content = content_of(markup)
        message = Message(kind, device, content, ns_to_ticks(time_ns))
        return peer_item(time_ns, _LINK, join(encode(message)))

    def _transform(self, node: _Node, scene: dict[str, _Node]) -> Transform:
        text = node.element.attributes.get("matrixTransformToParent", "")
        try:
            numbers = [float(word) for word in text.split()]
        except ValueError:
            numbers = []
        rows = [numbers[row : row + 4] for row in range(0, 16, 4)]
        why = counted(len(numbers), "number") if len(numbers) != 16 else no_pose(rows)
        if why:
            kept = scene.get(node.refers.get("storage", ""))
            found = (
                f"the file {kept.element.attributes.get('fileName', '')[:60]!r}"
                if kept and not text
                else repr(text[:60])
            )
            raise UnsupportedRecording(
                f"{self._path}: {node.name}: line {node.element.line}: found {found} ({why}), "
                "expected the matrix of a pose, 16 numbers"
            )
        return Transform.from_rows(rows)

    def _time(self, text: str, name: str) -> int:
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not 0 <= seconds * NS_PER_S + self.begin_ns < _END_NS:
            raise DamagedRecording(f"{self._path}: {name}: found the index {text[:40]!r}, expected seconds up to 2106")
        return self.begin_ns + round(seconds * NS_PER_S)

    def items(self) -> Iterator[ImportedItem]:
        yield from file_begin_items(self._path, self.begin_ns, _LINK)
        last_ns = self.begin_ns
        with library_errors_as_damage(self._path):
            for time_ns, item in heapq.merge(*self._streams, key=lambda one: one[0]):
                last_ns = max(last_ns, time_ns)
                yield item
        yield file_end_item(self._path, last_ns, _LINK, "the end of the scene")

    def close(self) -> None:
        for each in self._opened:
            each.close()


def _renamed(item: ImportedItem, device: str) -> ImportedItem:
    """Return a message under the name of another device, which its checksum does not cover."""
    data = bytearray(item.payload)
    data[DEVICE_NAME_AT : DEVICE_NAME_AT + _NAME] = device.encode("utf-8", "replace")[:_NAME].ljust(_NAME, b"\0")
    return replace(item, payload=memoryview(data), channel=f"{item.type}/{device}")


def _markup(path: Path, where: str) -> Markup:
    """Return the markups of a file, which has one list."""
    try:
        markups = read_markups(path)
    except GatewayError as error:
        raise type(error)(str(error).replace(str(path), where)) from None
    if len(markups) != 1:
        raise DamagedRecording(f"{where}: found {counted(len(markups), 'list')} of points, expected markups with one")
    return markups[0]
