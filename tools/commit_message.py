"""Checks a commit message: a subject of at most 72 characters, a blank line, and a body that gives the reason.

    python tools/commit_message.py .git/COMMIT_EDITMSG    this message
    python tools/commit_message.py --history              the messages of all commits since ``SINCE``

``make hooks`` installs it as git's commit-msg hook, and ``make quick`` checks the history, or what a clone
has of it.  Merges, reverts and commits for ``git rebase --autosquash``, whose messages git writes, pass unchecked.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: The first moment from which on every commit has to follow the rules: some older ones do not.
SINCE = "2026-11-28T12:00:00Z"
SUBJECT_LENGTH = 72
#: How subjects begin that git writes.
WRITTEN_BY_GIT = ("Merge ", "Revert ", "fixup! ", "squash! ", "amend! ")
#: What `git commit --verbose` puts before the diff.
SCISSORS = "# ------------------------ >8 ------------------------"


def faults(message: str) -> list[str]:
    """One sentence for each rule that ``message``, as the editor left it, breaks."""
    text = message.partition(SCISSORS)[0]
    lines = [line.rstrip() for line in text.splitlines() if not line.startswith("#")]
    subject, *rest = "\n".join(lines).strip().split("\n")
    if subject.startswith(WRITTEN_BY_GIT):
        return []
    if not subject:
        return ["The message is empty."]
    found = []
    if len(subject) > SUBJECT_LENGTH:
        found.append(f"The subject has {len(subject)} characters; at most {SUBJECT_LENGTH} are allowed.")
    if rest and rest[0]:
        found.append("The second line must be blank: it separates the subject from the body.")
    if not any(rest):
        found.append("The body is missing: it gives the reason for the change.")
    return found


def history_faults(root: Path = ROOT, since: str = SINCE) -> list[str]:
    """The same for all commits since a moment (ISO 8601), with the commit; nothing outside of a repository of git."""
    command = ["git", "log", "-z", f"--since-as-filter={since}", "--format=%h%n%B"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, encoding="utf-8", check=False)
    if done.returncode and (root / ".git").exists():
        return [f"git log: {done.stderr.strip()}"]
    found = []
    for commit in filter(None, done.stdout.split("\0")):
        name, _, message = commit.partition("\n")
        found += [f"{name}: {fault}" for fault in faults(message)]
    return found


def main(arguments: list[str]) -> int:
    """Check the file that git names, or the history; 1 where a message breaks a rule."""
    found = history_faults() if arguments == ["--history"] else faults(Path(arguments[0]).read_text("utf-8"))
    for fault in found:
        print(fault, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
