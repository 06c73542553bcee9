"""A file's bytes and its format, told by its content. XML with entities is refused, and so are files too large."""

from __future__ import annotations

import gzip
import io
import tempfile
import zlib
from pathlib import Path
from xml.etree import ElementTree

from gridsim.errors import GridSimError
from gridsim.packages import DISTRIBUTION
from gridsim.reading import MAX_BYTES, read_bytes, shown

Element = ElementTree.Element
INSTALL = f'pip install "{DISTRIBUTION}[roads]"'
FORMATS = "OpenStreetMap, OpenDRIVE, SUMO (.net.xml), CommonRoad and Lanelet2"


def read_content(path: Path) -> bytes:
    """A file's bytes: gzip is unpacked, a .pbf converted to XML. Its content, not its name, tells what it is."""
    data = read_bytes(path)
    if data[:2] == b"\x1f\x8b":
        try:
            data = gzip.GzipFile(fileobj=io.BytesIO(data)).read(MAX_BYTES + 1)
        except (OSError, EOFError, zlib.error):
            raise GridSimError(f"{path}: a truncated or damaged .gz") from None
        if len(data) > MAX_BYTES:
            raise GridSimError(f"{path}: more than {MAX_BYTES >> 20} MiB when unpacked; make it smaller")
    if not data.strip():
        raise GridSimError(f"{path}: the file is empty")
    if b"OSMHeader" in data[:64]:
        return _from_pbf(path, data)
    return data


def _from_pbf(path: Path, data: bytes) -> bytes:
    """The content of a .pbf, OpenStreetMap's binary format, as XML."""
    try:
        import osmium
    except ImportError:
        raise GridSimError(f"{path}: a .pbf needs osmium: {INSTALL}") from None
    with tempfile.TemporaryDirectory() as folder:
        unpacked = Path(folder) / "all.osm"
        try:
            with osmium.SimpleWriter(str(unpacked)) as writer:
                for k, thing in enumerate(osmium.FileProcessor(osmium.io.FileBuffer(data, "pbf"))):
                    writer.add(thing)
                    if k % 100_000 == 0 and unpacked.stat().st_size > MAX_BYTES:
                        break
        except RuntimeError as error:
            raise GridSimError(f"{path}: truncated or damaged: {shown(str(error))}") from None
        if unpacked.stat().st_size > MAX_BYTES:
            text = f"more than {MAX_BYTES >> 20} MiB when unpacked; cut a part out: osmium extract -b W,S,E,N"
            raise GridSimError(f"{path}: {text}")
        return unpacked.read_bytes()


def parse(path: Path, data: bytes) -> Element:
    """The root of an XML file."""
    # No format of roads needs a document type; entities in it could grow without limit, or read files.
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data or b"\0" in data[:64]:
        text = "not a picture (.png, .jpg, .pgm, .bmp), nor plain XML in UTF-8 without a document type or entities"
        raise GridSimError(f"{path}: {text}")
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        if data.lstrip()[:1] != b"<":
            raise GridSimError(f"{path}: not a map: it is neither XML nor a picture; there are {FORMATS}") from None
        raise GridSimError(f"{path}: truncated or damaged XML: {shown(str(error))}") from None
    for element in root.iter() if root.tag.startswith("{") else ():
        element.tag = element.tag.rpartition("}")[2]  # without the file's namespace
    return root


def format_of(path: Path, data: bytes, root: Element) -> str:
    """A file's format: osm, lanelet2, opendrive, sumo or commonroad."""
    name = root.tag
    if name == "osm":
        return "lanelet2" if b"lanelet" in data and _has_lanelets(root) else "osm"
    known = {"OpenDRIVE": "opendrive", "net": "sumo", "commonRoad": "commonroad"}
    if name not in known:
        raise GridSimError(f"{path}: XML of another kind, <{name[:30]}>; there are {FORMATS}")
    return known[name]


def _has_lanelets(root: Element) -> bool:
    return any(tag.get("k") == "type" and tag.get("v") == "lanelet" for tag in root.iterfind("relation/tag"))
