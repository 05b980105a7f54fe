"""``tools/publish.py``: the tag of a release is pushed once, with its commit, and only if all is right."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from igtl_gateway.base.version import __version__
from tests.places import ROOT
from tools import publish as module
from tools.publish import VERSIONS, PublishError, check_versions, publish


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "init.defaultBranch=main")
    return subprocess.run(["git", *who, *words], cwd=folder, check=True, capture_output=True, text=True).stdout.strip()


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with a remote, in which nothing but a file has a version."""
    for name in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{name}_NAME", "A")
        monkeypatch.setenv(f"GIT_{name}_EMAIL", "a@example.org")
    monkeypatch.setattr(module, "VERSIONS", {"version": "^(.+)$"})
    git(tmp_path, "init", "--bare", "remote")
    git(tmp_path, "clone", "remote", "checkout")
    folder = tmp_path / "checkout"
    git(folder, "checkout", "-b", "main")
    (folder / "version").write_text("1.2.3\n")
    git(folder, "add", "version")
    git(folder, "commit", "-m", "a")
    git(folder, "push", "origin", "main")
    return folder


def test_all_places_have_the_version_of_the_package() -> None:
    check_versions(ROOT, __version__)
    assert set(VERSIONS) >= {"CITATION.cff", "CHANGELOG.md", "ros2/igtl_msgs/package.xml"}


def test_commit_and_tag_are_pushed_together(checkout: Path) -> None:
    git(checkout, "commit", "--allow-empty", "-m", "b")
    assert publish(checkout, "1.2.3", "origin", dry_run=True) == "v1.2.3"
    assert not git(checkout, "tag")
    assert publish(checkout, "1.2.3", "origin") == "v1.2.3"
    remote = checkout.parent / "remote"
    assert (
        git(remote, "rev-parse", "main")
        == git(remote, "rev-parse", "v1.2.3^{commit}")
        == git(checkout, "rev-parse", "HEAD")
    )
    with pytest.raises(PublishError, match=r"found the tag v1\.2\.3, expected none"):
        publish(checkout, "1.2.3", "origin")
    git(checkout, "tag", "--delete", "v1.2.3")
    with pytest.raises(PublishError, match=r"found the tag v1\.2\.3, expected none"):
        publish(checkout, "1.2.3", "origin")


def test_what_is_not_a_release_is_not_tagged(checkout: Path) -> None:
    with pytest.raises(PublishError, match=r"version: found the version 1\.2\.3, expected 1\.2\.4"):
        publish(checkout, "1.2.4", "origin")
    (checkout / "more").touch()
    with pytest.raises(PublishError, match="changes that are not committed"):
        publish(checkout, "1.2.3", "origin")
    (checkout / "more").unlink()
    git(checkout.parent, "clone", "remote", "other")
    git(checkout.parent / "other", "commit", "--allow-empty", "-m", "c")
    git(checkout.parent / "other", "push", "origin", "main")
    with pytest.raises(PublishError, match="found newer commits in origin"):
        publish(checkout, "1.2.3", "origin")
    assert not git(checkout, "tag")


def test_a_push_that_is_refused_leaves_no_tag(checkout: Path) -> None:
    hook = checkout.parent / "remote" / "hooks" / "pre-receive"
    hook.write_text("#!/bin/sh\nexit 1\n")
    hook.chmod(0o755)
    with pytest.raises(PublishError, match="git push"):
        publish(checkout, "1.2.3", "origin")
    assert not git(checkout, "tag")
