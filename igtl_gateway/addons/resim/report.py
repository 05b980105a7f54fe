"""The verdict in full: lines for a person who has to find out why a test fails, and JUnit XML for CI."""

from __future__ import annotations

import re
from xml.etree import ElementTree

from igtl_gateway.addon.terminal import count_text
from igtl_gateway.addon.untrusted import printable
from igtl_gateway.addons.resim.engine import RunResult
from igtl_gateway.addons.resim.verdict import StreamVerdict, Verdict, is_judged

#: Of the streams that are named one by one.
_SHOWN = 20
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def report_lines(result: RunResult, verdict: Verdict) -> list[str]:
    """The verdict, the streams that differ, and what was input and output; a line each."""
    lines = [verdict.line()]
    differing = [each for each in verdict.between_runs or verdict.streams if not each.is_equal]
    for stream in differing[:_SHOWN]:
        lines.append(f"  {_counts(stream)}")
        if stream.first:
            lines.append(f"    first: {stream.first.text(verdict.start_ns)}")
    if len(differing) > _SHOWN:
        lines.append(f"  … and {count_text(len(differing) - _SHOWN, 'stream')} more")
    if roles := result.roles:
        inputs = ", ".join(f"{name} ({count:,})" for name, count in roles.inputs.items()) or "none"
        lines += [
            f"  inputs: {inputs}",
            f"  outputs: {', '.join(name for name in roles.outputs if is_judged(name)) or 'none'}",
        ]
        if roles.missing:
            lines.append(f"  asked for, but not recorded: {', '.join(roles.missing)}")
    lines += [f"  {lost.text(verdict.start_ns)}" for one in result.runs[:1] for lost in one.lost]
    return [printable(line) for line in lines]


def _counts(stream: StreamVerdict) -> str:
    """The statistics of a stream that differs."""
    parts = [
        (stream.different, "differ"),
        (stream.missing, "missing"),
        (stream.extra, "more"),
        (stream.late, "at another time"),
        (stream.within, "within the tolerance"),
    ]
    found = ", ".join(f"{count:,} {what}" for count, what in parts if count)
    most = [f"{stream.mm:.6g} mm"] * bool(stream.mm) + [f"{stream.deg:.6g}°"] * bool(stream.deg)
    largest = f"; at most {', '.join(most)}" if most else ""
    return f"{stream.stream}: {count_text(stream.messages, 'message')}: {found}{largest}"


def junit_xml(result: RunResult, verdict: Verdict, outputs: tuple[str, ...] = ()) -> bytes:
    """The verdict in the format of JUnit: a test case for determinism, and one for each stream.

    A program that ended or hung is an error; a difference, or a timer that races a topic, is a failure; a stream that
    nothing could be compared with is skipped.  Properties of the suite are a race that is permitted, a sample, and
    messages that full queues have dropped.

    Args:
        result: of ``engine.run``.
        verdict: on it.
        outputs: globs of topics that are judged although every node has them.
    """
    suites = ElementTree.Element("testsuites", name="igtl-gateway resim")
    suite = ElementTree.SubElement(suites, "testsuite", name=_xml(result.recording.name))
    seconds = sum(one.seconds for one in result.runs)
    facts = [("lost", lost.text(verdict.start_ns)) for one in result.runs[:1] for lost in one.lost]
    if verdict.race and not verdict.is_racing:
        facts.append(("race", verdict.race.text(verdict.start_ns)))
    facts += [("not published", name) for name in verdict.unpublished]
    if facts:
        properties = ElementTree.SubElement(suite, "properties")
        for name, value in facts:
            ElementTree.SubElement(properties, "property", name=name, value=_xml(value))
    runs = _case(suite, result, f"deterministic: {count_text(len(result.runs), 'run')}", seconds)
    if verdict.fault:
        _outcome(runs, "error", "fault", verdict.line(), verdict.line())
    elif not verdict.is_deterministic:
        _outcome(runs, "failure", "not deterministic", verdict.line(), "\n".join(report_lines(result, verdict)))
    compared = {each.stream: each for each in verdict.between_runs or verdict.streams}
    made = {name for one in result.runs for name in one.streams if is_judged(name, outputs)}
    for name in sorted(made | set(compared)):
        case = _case(suite, result, name, 0.0)
        stream = compared.get(name)
        if stream and stream.first and not stream.is_equal:
            _outcome(case, "failure", stream.first.what, stream.first.text(verdict.start_ns), _counts(stream))
        elif not stream and (verdict.fault or verdict.unequal_run):
            _outcome(case, "skipped", "", "not compared: the runs cannot be judged or differ", "")
        elif not stream:
            what = verdict.reference.name if verdict.reference else "a baseline"
            why = "its type cannot be read" if name in verdict.uncompared else f"not in {what}"
            _outcome(case, "skipped", "", f"not compared: {why}", "")
    for parent in (suite, suites):
        parent.set("tests", str(len(suite.findall("testcase"))))
        parent.set("failures", str(len(suite.findall("*/failure"))))
        parent.set("errors", str(len(suite.findall("*/error"))))
        parent.set("skipped", str(len(suite.findall("*/skipped"))))
        parent.set("time", f"{seconds:.3f}")
    del suites.attrib["skipped"]  # only a suite has it
    ElementTree.indent(suites)
    return bytes(ElementTree.tostring(suites, "utf-8", xml_declaration=True)) + b"\n"


def _case(suite: ElementTree.Element, result: RunResult, name: str, seconds: float) -> ElementTree.Element:
    group = f"resim.{result.recording.stem}"
    return ElementTree.SubElement(suite, "testcase", classname=_xml(group), name=_xml(name), time=f"{seconds:.3f}")


def _outcome(case: ElementTree.Element, tag: str, type_: str, message: str, text: str) -> None:
    found = ElementTree.SubElement(case, tag, message=_xml(message))
    if type_:
        found.set("type", type_)
    found.text = _xml(text)


def _xml(text: str) -> str:
    """Text without the characters that XML cannot have."""
    return _NOT_XML.sub("\N{REPLACEMENT CHARACTER}", text)
