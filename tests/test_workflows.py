"""GitHub's workflows and forms, and the citation file: they parse, name what exists, and agree with pyproject.toml."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from igtl_gateway.base.version import __version__
from igtl_gateway.base.versions import tomllib
from tests.places import ROOT

GITHUB = ROOT / ".github"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
WORKFLOWS = sorted(path.name for path in (GITHUB / "workflows").iterdir())
PYTHONS = ["3.10", "3.11", "3.12", "3.13", "3.14"]
SYSTEMS = ["ubuntu-22.04", "ubuntu-24.04"]
#: The same on aarch64, for which there are no ROS wheels.
ARM = [f"{system}-arm" for system in SYSTEMS]
#: Where a session over Zenoh is tried.
OTHER_SYSTEMS = ["macos-latest", "windows-latest"]
#: Programs of GitHub's machines that the workflows use.
TOOLS = {"gh", "python", "rm", "sha256sum"}
#: Actions in the versions that we know; any other is a decision.
ACTIONS = {
    "actions/attest-build-provenance@v2",
    "actions/checkout@v4",
    "actions/download-artifact@v4",
    "actions/setup-python@v5",
    "actions/upload-artifact@v4",
    "pypa/gh-action-pypi-publish@release/v1",
}


def yaml(path: Path) -> Any:
    return YAML(typ="safe", pure=True).load(path)


def workflow(name: str) -> Any:
    return yaml(GITHUB / "workflows" / name)


def steps(name: str) -> Iterator[tuple[str, dict[str, Any]]]:
    for job, content in workflow(name)["jobs"].items():
        yield from ((job, step) for step in content["steps"])


def targets() -> set[str]:
    return set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))


@pytest.mark.parametrize("name", WORKFLOWS)
def test_every_step_runs_something_that_exists(name: str) -> None:
    for job, step in steps(name):
        assert ("run" in step) != ("uses" in step), job
        if "uses" in step:
            assert step["uses"] in ACTIONS
            continue
        first, *words = step["run"].split()
        if first == "make":
            assert set(words) <= targets(), step["run"]
        elif first == "python":
            assert (ROOT / words[0]).is_file(), step["run"]
        else:
            assert first in TOOLS or (ROOT / first).is_file(), step["run"]


@pytest.mark.parametrize("name", WORKFLOWS)
def test_jobs_end_have_few_rights_and_name_other_jobs(name: str) -> None:
    content = workflow(name)
    assert content["permissions"] == {"contents": "read"}
    for job, description in content["jobs"].items():
        assert description["timeout-minutes"] <= 60
        needs = description.get("needs", [])
        assert {needs} if isinstance(needs, str) else set(needs) <= content["jobs"].keys()
        matrix = description.get("strategy", {}).get("matrix", {})
        assert description["runs-on"] in SYSTEMS + ARM or description["runs-on"] == "${{ matrix.os }}", job
        assert set(re.findall(r"\$\{\{ matrix\.(\w+) \}\}", str(description))) == matrix.keys(), job
    with_rights = {job for job, description in content["jobs"].items() if "permissions" in description}
    assert with_rights == ({"publish"} if name == "release.yml" else set())


@pytest.mark.parametrize("name", WORKFLOWS)
def test_no_address_is_written_into_a_workflow(name: str) -> None:
    assert "://" not in (GITHUB / "workflows" / name).read_text("utf-8")


def test_ci_runs_the_gate_and_the_core_on_all_that_we_promise() -> None:
    content = workflow("ci.yml")
    assert {"push", "pull_request"} <= content["on"].keys()
    assert ".ci/run" in {step.get("run") for _, step in steps("ci.yml")}
    core = content["jobs"]["core"]
    assert core["strategy"]["matrix"] == {"os": SYSTEMS, "python": PYTHONS[1:-1]}
    ends = content["jobs"]["ends"]
    assert ends["env"]["PYTHONS"] == f"python{PYTHONS[0]} python{PYTHONS[-1]}"
    assert ends["steps"][1]["with"]["python-version"].split() == [PYTHONS[0], "3.11", PYTHONS[-1]]
    assert content["jobs"]["systems"]["strategy"]["matrix"] == {
        "os": OTHER_SYSTEMS,
        "python": [PYTHONS[0], PYTHONS[-1]],
    }
    extras = PROJECT["optional-dependencies"].keys()
    assert {"view", "video", "nifti", "pcap", "lab", "dev"} <= set(core["env"]["EXTRAS"].split(",")) <= extras - {"ros"}
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"


def test_a_release_is_built_on_the_oldest_system_tried_on_all_and_published_by_tags_only() -> None:
    jobs = workflow("release.yml")["jobs"]
    for job, system in (("arm", ARM[0]), ("build", SYSTEMS[0])):
        assert jobs[job]["runs-on"] == system
        assert jobs[job]["env"]["PYTHONS"].split() == [f"python{version}" for version in PYTHONS]
        (versions,) = (
            step["with"]["python-version"] for step in jobs[job]["steps"] if "python-version" in step.get("with", {})
        )
        assert versions.split() == PYTHONS
    given, taken = (
        next(step["with"] for step in jobs[job]["steps"] if step.get("with", {}).get("name") == "wheels")
        for job in ("arm", "build")
    )
    assert given["path"] == taken["path"] == jobs["build"]["env"]["WHEELS"] and jobs["build"]["needs"] == "arm"
    assert jobs["try"]["strategy"]["matrix"] == {"os": SYSTEMS + ARM, "python": PYTHONS}
    assert jobs["try"]["needs"] == "build"
    assert jobs["publish"]["needs"] == "try"
    assert jobs["publish"]["if"] == "startsWith(github.ref, 'refs/tags/v')"
    assert jobs["publish"]["permissions"]["id-token"] == "write"
    assert "password" not in str(jobs), "trusted publishing needs none"


def test_the_citation_file_has_what_its_schema_requires() -> None:
    citation = yaml(ROOT / "CITATION.cff")
    assert {"cff-version", "message", "title", "authors"} <= citation.keys()
    assert citation["cff-version"] == "1.2.0"
    assert citation["type"] == "software"
    assert citation["title"] == PROJECT["name"]
    assert citation["version"] == __version__
    assert citation["license"] == PROJECT["license"]
    assert all("name" in author or "family-names" in author for author in citation["authors"])
    for reference in citation["references"]:
        assert {"authors", "title", "type"} <= reference.keys()
        assert re.fullmatch(r"10\.\d{4,9}/\S+", reference["doi"])


@pytest.mark.parametrize("name", ["bug.yml", "feature.yml"])
def test_the_forms_have_the_fields_that_github_requires(name: str) -> None:
    form = yaml(GITHUB / "ISSUE_TEMPLATE" / name)
    assert {"name", "description", "body"} <= form.keys()
    fields = [each for each in form["body"] if each["type"] != "markdown"]
    assert {each["type"] for each in fields} <= {"textarea", "input", "dropdown", "checkboxes"}
    assert len({each["id"] for each in fields}) == len(fields) > 0
    assert all(each["attributes"]["label"] for each in fields)


def test_a_bug_report_asks_for_versions_and_diagnosis() -> None:
    fields = {each.get("id"): each for each in yaml(GITHUB / "ISSUE_TEMPLATE" / "bug.yml")["body"]}
    assert "igtl-gateway --version" in fields["version"]["attributes"]["description"]
    assert fields["version"]["validations"]["required"] is True
    assert "igtl-gateway doctor" in fields["doctor"]["attributes"]["description"]


@pytest.mark.parametrize("page", ["SECURITY.md", "CODE_OF_CONDUCT.md"])
def test_links_of_the_community_pages_exist(page: str) -> None:
    links = re.findall(r"\]\(([^)#]+)", (ROOT / page).read_text("utf-8"))
    assert [link for link in links if "://" not in link and not (ROOT / link).is_file()] == []
