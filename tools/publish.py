"""Publish the release of the last commit: ``make publish``.

    python -m tools.publish [--remote origin] [--dry-run]

It checks that the commit is a release, tags it, and pushes the commit and the tag in one step.  The tag starts
``.github/workflows/release.yml``, which builds, tries, attests and publishes.  After an error there is no tag.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

from igtl_gateway.base.version import __version__

ROOT = Path(__file__).parents[1]
#: File → the place of the version.
VERSIONS = {
    "CITATION.cff": r"^version: (.+)$",
    "CHANGELOG.md": r"^## (.+)$",
    "deploy/conda/recipe.yaml": r'^  version: "(.+)"$',
    "igtl_gateway/base/version.py": r'^__version__ = "(.+)"$',
    "lab/igtl_gateway_lab/__init__.py": r'^__version__ = "(.+)"$',
    "ros2/igtl_gateway_ros/package.xml": r"^  <version>(.+)</version>$",
    "ros2/igtl_gateway_ros/setup.cfg": r"^version = (.+)$",
    "ros2/igtl_msgs/package.xml": r"^  <version>(.+)</version>$",
}


class PublishError(Exception):
    """Nothing was published, for the reason in the text."""


def check_versions(root: Path, version: str) -> None:
    """Raise PublishError unless each place has the version; of the changelog, the newest section."""
    for name, pattern in VERSIONS.items():
        found = re.search(pattern, (root / name).read_text("utf-8"), re.MULTILINE)
        if found is None or found[1] != version:
            raise PublishError(f"{name}: found the version {found[1] if found else 'nowhere'}, expected {version}")


def publish(root: Path, version: str, remote: str, *, dry_run: bool = False) -> str:
    """Tag the last commit of the repository at ``root``, push both, and return the tag.  Raises PublishError."""
    tag = f"v{version}"
    check_versions(root, version)
    if _git(root, "status", "--porcelain"):
        raise PublishError("found changes that are not committed: a release is a commit")
    branch = _git(root, "symbolic-ref", "--short", "HEAD")
    if _git(root, "tag", "--list", tag) or _git(root, "ls-remote", "--tags", remote, f"refs/tags/{tag}"):
        raise PublishError(f"found the tag {tag}, expected none: each version is published once")
    _git(root, "fetch", "--quiet", remote, branch)
    if _git(root, "rev-list", "--count", "HEAD..FETCH_HEAD") != "0":
        raise PublishError(f"found newer commits in {remote}, expected the last one here")
    if dry_run:
        return tag
    _git(root, "tag", "--annotate", tag, "--message", f"igtl-gateway {version}")
    try:
        _git(root, "push", "--quiet", "--atomic", remote, f"HEAD:refs/heads/{branch}", f"refs/tags/{tag}")
    except PublishError:
        _git(root, "tag", "--delete", tag)
        raise
    return tag


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=False)
    if done.returncode:
        raise PublishError(f"git {' '.join(words)}: {done.stderr.strip() or f'exit code {done.returncode}'}")
    return done.stdout.strip()


def main() -> int:
    """Print what was published, or why not."""
    parser = argparse.ArgumentParser(description="Tag the release of the last commit, and push it.")
    parser.add_argument("--remote", default="origin", help="of the project's repository (default: origin)")
    parser.add_argument("--dry-run", action="store_true", help="only check")
    options = parser.parse_args()
    try:
        tag = publish(ROOT, __version__, options.remote, dry_run=options.dry_run)
    except PublishError as error:
        print(error, file=sys.stderr)
        return 1
    print(f"{tag}: all checks passed" if options.dry_run else f"pushed {tag}: the workflow `release` publishes it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
