#!/bin/sh
# eclipse-zenoh: a program that declared a callback and closes nothing never ends.
#
# Expected: a program ends behind its last line, as with threads that Python knows to be daemons.
#           Guess before the run: every session that is not closed hangs.
# Found: only those with a callback do, of a subscriber or a queryable.  A session alone, with a subscriber that has a
#        queue, or with a liveliness token, ends.  `session.close()`, or `with zenoh.open(...)`, ends them all.
# Versions: eclipse-zenoh 1.10.2, Python 3.11.
# Concerns: who writes a small program with a callback: in a test or a service it stays until it is killed.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check eclipse-zenoh==1.10.2
cat > "$folder/run.py" <<'PYTHON'
import sys
import zenoh

config = '{mode: "peer", listen: {endpoints: ["tcp/127.0.0.1:0"]}, scouting: {multicast: {enabled: false}}}'
session = zenoh.open(zenoh.Config.from_json5(config))
kept = {
    "nothing": lambda: None,
    "queue": lambda: session.declare_subscriber("a/b"),
    "token": lambda: session.liveliness().declare_token("a/b"),
    "subscriber": lambda: session.declare_subscriber("a/b", lambda sample: None),
    "queryable": lambda: session.declare_queryable("a/b", lambda query: None),
}[sys.argv[1]]()
if len(sys.argv) > 2:
    session.close()
print("last line", flush=True)
PYTHON
for what in nothing queue token subscriber queryable; do
    code=0
    timeout 10 "$folder/venv/bin/python" "$folder/run.py" $what > "$folder/out" || code=$?
    closed=0
    timeout 10 "$folder/venv/bin/python" "$folder/run.py" $what close > "$folder/out" || closed=$?
    echo "$what: exit code $code, with close() $closed"
    grep -q "last line" "$folder/out"
    case $what in subscriber | queryable) test $code -eq 124 ;; *) test $code -eq 0 ;; esac
    test $closed -eq 0
done
