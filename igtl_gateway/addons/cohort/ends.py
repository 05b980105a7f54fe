"""How the task of a file ends, and the names of the verbs: without the modules that do the work."""

from __future__ import annotations

#: The verbs that read files; ``jobs`` has what they do.
VERB_NAMES = ("info", "lint", "verify", "review", "sync")
#: The verb that makes one data set of all files, and no table.
EXPORT = "export"

OK, NOTHING, BROKEN, UNSUPPORTED, GROWING = "ok", "nothing_to_do", "broken", "unsupported", "being_recorded"
TIMEOUT, MEMORY, KILLED, UNREACHABLE, FAILED = "timeout", "memory", "killed", "unreachable", "failed"
#: The file has another mark and the same content.
UNCHANGED = "unchanged"
#: Verdict of `sync` about a stream that cannot be read.
UNREADABLE = "unreadable"
#: Ends that are facts about the file and not about the machine or the moment: a second run does not try again.
FINAL = frozenset({OK, NOTHING, BROKEN, UNSUPPORTED})
