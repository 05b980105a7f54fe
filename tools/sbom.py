"""The SBOM of a release in CycloneDX 1.6 (JSON): its files, and the pinned distributions that users install with it.

Strategy: walk the requirements as ``tools/constraints.py`` does, in the environment that has the versions of
``constraints.txt``; CycloneDX's own library writes the file, and its schema judges it.  Names and versions come from
the metadata of the distributions; hashes are those of our own files.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timezone
from hashlib import sha256
from importlib.metadata import Distribution, distribution
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import NAMESPACE_URL, uuid5
from xml.etree import ElementTree

from cyclonedx.factory.license import LicenseFactory
from cyclonedx.model import HashAlgorithm, HashType
from cyclonedx.model.bom import Bom
from cyclonedx.model.component import Component, ComponentType
from cyclonedx.output.json import JsonV1Dot6
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packageurl import PackageURL
from packaging.requirements import Requirement

from tools.constraints import EXTRAS, requirements

if TYPE_CHECKING:
    from cyclonedx.model.license import License

NAME = "igtl-gateway"
PROJECT = Requirement(f"{NAME}[{EXTRAS}]")
#: A field of the metadata that is longer has the text of a licence, not its name.
_LONGEST_NAME = 80


def write_sbom(folder: Path, files: Iterable[Path], epoch: int) -> Path:
    """Write the SBOM of the release that has these ``files``, and return its path.

    Args:
        folder: for the file.
        files: sdists and wheels; the SBOM has their SHA-256.
        epoch: time of the release, in seconds since 1970 UTC.

    Raises:
        ValueError: a requirement is not installed, or the file does not follow the schema.
    """
    bom = release_bom(files, epoch)
    text = JsonV1Dot6(bom).output_as_string(indent=1)
    if errors := JsonStrictValidator(SchemaVersion.V1_6).validate_str(text):
        raise ValueError(f"the SBOM does not follow the schema of CycloneDX 1.6: {errors}")
    path = folder / f"{NAME}-{distribution(NAME).version}.cdx.json"
    path.write_text(f"{text}\n", "utf-8")
    return path


def release_bom(files: Iterable[Path], epoch: int) -> Bom:
    """Return the SBOM; equal arguments in equal environments give an equal SBOM.  Raises ValueError."""
    needs = requirements(PROJECT)
    if absent := sorted({name for names in needs.values() for name in names} - needs.keys()):
        raise ValueError(f"found no {', '.join(absent)}, expected all that {PROJECT} needs to be installed")
    components = {name: _component(name) for name in needs}
    bom = Bom()
    bom.metadata.timestamp = datetime.fromtimestamp(epoch, timezone.utc)
    bom.metadata.component = components[NAME]
    bom.serial_number = uuid5(NAMESPACE_URL, f"{NAME}-{distribution(NAME).version}-{epoch}")
    for path in files:
        digest = HashType(alg=HashAlgorithm.SHA_256, content=sha256(path.read_bytes()).hexdigest())
        file = Component(name=path.name, type=ComponentType.FILE, bom_ref=path.name, hashes=[digest])
        components[NAME].components.add(file)
    for name, component in components.items():
        if name != NAME:
            bom.components.add(component)
        bom.register_dependency(component, [components[need] for need in needs[name]])
    return bom


def _component(name: str) -> Component:
    found = distribution(name)
    url = PackageURL("pypi", name=name, version=found.version)
    return Component(
        name=name,
        version=found.version,
        type=ComponentType.APPLICATION if name == NAME else ComponentType.LIBRARY,
        purl=url,
        bom_ref=str(url),
        description=found.metadata["Summary"],
        licenses=_licences(found),
    )


def _licences(found: Distribution) -> list[License]:
    """The licence in the metadata: an expression of SPDX, a name, a classifier; for ROS in package.xml."""
    metadata = found.metadata
    names = [text for text in metadata.get_all("License") or [] if "\n" not in text and len(text) <= _LONGEST_NAME]
    classifiers = [line.rpartition(" :: ")[2] for line in metadata.get_all("Classifier") or [] if "License ::" in line]
    manifests = [path for path in found.files or [] if path.name == "package.xml"]
    in_manifests = [
        element.text
        for path in manifests
        for element in ElementTree.parse(path.locate()).iter("license")
        if element.text
    ]
    text = next(iter([*(metadata.get_all("License-Expression") or []), *names, *classifiers]), None)
    return [LicenseFactory().make_from_string(name) for name in ([text] if text else in_manifests)]
