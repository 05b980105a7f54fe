"""Checks a commit message: a subject of at most 72 characters, a blank line, and a body that gives the reason.

    python tools/commit_message.py .git/COMMIT_EDITMSG

``make hooks`` installs it as git's commit-msg hook.  Merges, reverts and commits for ``git rebase --autosquash``, whose
messages git writes, pass unchecked.
"""

from __future__ import annotations

import sys
from pathlib import Path

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


def main(arguments: list[str]) -> int:
    """Check the file that git names; 1 where the message breaks a rule."""
    found = faults(Path(arguments[0]).read_text("utf-8"))
    for fault in found:
        print(fault, file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
