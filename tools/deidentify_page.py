"""docs/how-to/deidentify.md: the table of the rules from the code, and what surrounds it."""

from __future__ import annotations

from igtl_gateway.addons.deidentify.pseudonyms import MIN_KEY_BYTES
from igtl_gateway.addons.deidentify.rules import NOT_COVERED, OPTIONS, RULES

TITLE = "# De-identification of sessions"

BEFORE = """\
`igtl-gateway deidentify` writes a session without names, text and dates of persons. It changes the inputs, and the
gateway computes the outputs from them again. So the result verifies like every recording, and all verbs read it.

```console
$ igtl-gateway deidentify out.mcap -o clean.mcap --secret study.key --profile study.toml
$ igtl-gateway verify clean.mcap
```

The file is complete or absent at the end, only its owner can read it (mode 0600), and an existing file stays without
`--overwrite`. A damaged recording is refused: `recover` it first. Files of other programs are imported first. The
parts of a split recording become one file; the prologue of a snapshot is changed like the rest. If the
recording is sealed, the result has no seal, and its metadata name the last seal of the recording (`derived_from`). Of a
merged session, each part is de-identified by itself.

The actions in the table have the letters of DICOM PS3.15 (X remove, Z empty, C clean, U consistent pseudonym, K
keep), and the options have its codes. `--json` prints the counts of each rule; the last note of the result and the
key `deidentified` of its metadata have them, too. Nothing in the result names what was replaced.

## Rules"""

SECTIONS = f"""\
## Pseudonyms and times

A pseudonym is the beginning of the HMAC-SHA-256 of a name with a key. The same `--secret FILE` (at least
{MIN_KEY_BYTES} bytes) gives the same pseudonyms in all sessions, so that a study can link them. Without `--secret`
the key is random and is not stored. Who has the key can test whether a name belongs to a pseudonym: keep it apart
from the data.

`AToB` is replaced part by part, so that transforms keep their frames. Words of ROS and of the gateway, such as `tf`
or `igtl`, stay. If two names get the same pseudonym, the verb ends with an error.

All times move by one constant, whole seconds between one day and ten years into the past, which follows from the key;
`--shift S` sets it, `--keep-times` keeps the times. Intervals stay exact, in ticks and in nanoseconds. Times before
1990 are no dates (time since the start of a machine) and stay, as does 0. The constant is not in the result.

## Profiles

The profile `basic` keeps no name, no text and no metadata. `--profile FILE` adds to it:

```toml
[keep]
names = ["Probe", "Tracker*"]      # globs of names that stay
metadata = ["modality"]            # globs of metadata keys that stay with their values
types = ["my_msgs/msg/Force"]      # types without a known layout, and 8-bit arrays (NDARRAY), whose messages stay

[names]                            # new names instead of pseudonyms
PatientSmith_CT = "CT"

[[text]]                           # text; the first row that matches the stream applies
stream = "STRING/State*"
action = "keep"                    # remove (default), keep, replace (by), pattern

[[text]]
stream = "/log"
action = "pattern"                 # only what matches is replaced
pattern = "[A-Z][a-z]+ [A-Z][a-z]+"
by = "(name)"

[[mask]]                           # pixels; the first row that matches the stream applies
stream = "IMAGE/Ultrasound"
rectangles = [[0, 0, 640, 40]]     # x, y, width, height
fan = [320, 20, 60, 400, 45, 135]  # apex x, y; near, far; from, to (degrees, 90: down): all outside is hidden
value = 0
```

A `pattern` is a regular expression of Python. A process of its own searches, and the text of a message may take 5 s: a
pattern that repeats a repetition, such as `(a+)+$`, can take longer than the session for a short text. Then
`deidentify` ends with exit code 2, names the pattern, and writes no file.

Streams are named as in the recording: `TYPE/device` or the topic. A mask applies to all slices of a volume, and to
parts of an image at their place. JPEG and PNG are decoded, masked and encoded again, as are H.264 and VP9 (PyAV, the
extra `video`). A masked picture that cannot be decoded or encoded again, such as H.265 or raw I420, is removed, and
without PyAV all encoded pictures with a mask. JPEG, PNG, H.264, H.265 and AV1 without a mask lose their text
(EXIF, comments, SEI, metadata, filling) and keep their pixels. A mask that is outside of a picture is reported, as are
rows of the profile that match nothing; if pictures are left without a mask beside such a mask, the exit code is 1.

Make a rectangle 8 pixels larger than the text on each side: video stores colour at half the resolution, so yellow text
leaves a coloured rim around itself. This was measured with yellow letters of 16 pixels in real ultrasound of tissue
(820 × 616, H.264 and VP9). With a rectangle that fits a name exactly (2 Mbit/s), pixels beside it differ by up to 31 of
255 between red, green and blue; with 8 pixels more, by 0. With a name, a birth date and a hospital on the picture
(8 Mbit/s), no pixel inside of the rectangle is above 9 of 255 in any of 12 frames, 3 of them key frames.

## What it does not cover
"""

AFTER = """\
Look at the result before it leaves: `igtl-gateway view clean.mcap`. It supports a de-identification and is no proof
of one. A message that cannot be cleaned with certainty is removed and counted: damaged ones, unknown types, 8-bit
arrays. If the recording has lost entries, the result has no gaps, because its entries are numbered again.
"""


def text(table: str, options: str) -> str:
    """Return the page without its first line; ``table`` and ``options`` are Markdown."""
    limits = "\n".join(f"- {each}" for each in NOT_COVERED)
    return f"{BEFORE}\n\n{table}\n\n{options}\n\n{SECTIONS}\n{limits}\n\n{AFTER}"


def rows() -> list[tuple[str, str, str, str, str]]:
    """Return rule, place, what happens, action and option of each rule."""
    return [(rule.name, rule.place, rule.what, rule.action.value, rule.option) for rule in RULES.values()]


def options() -> list[tuple[str, str]]:
    """Return code and meaning of each option."""
    return list(OPTIONS.items())
